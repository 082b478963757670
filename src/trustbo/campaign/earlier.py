"""Missions of earlier campaigns, which are data of a new campaign.

By Bayes' rule, the posterior of an earlier campaign, taken as the prior of a new one, gives the
posterior given the missions of both. The earlier missions therefore enter every fit.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

from trustbo.campaign.closing import Closing
from trustbo.campaign.result import Result
from trustbo.campaign.state import (
    EarlierMissions,
    Planned,
    planned_paths,
    why_never_learned,
)
from trustbo.data import Mission
from trustbo.display import joined
from trustbo.errors import TrustboError, require_list
from trustbo.hazard.trials import LostMission
from trustbo.identity import map_name
from trustbo.stacking import names_of_all, pooled
from trustbo.workspace import Workspace

_REMEDY = "give a result or campaign, or a list of them"


def earlier_missions(
    earlier: Result | Sequence[Result] | None, workspace: Workspace
) -> EarlierMissions:
    """Collect the missions of earlier campaigns for a campaign in a workspace.

    These are the missions that the campaigns used for learning, and those that they had taken from
    still earlier campaigns. A mission that several of the results contain is used once. Missions on
    the map of the workspace have the map "".

    Raises:
        TrustboError: An entry is not a result, its features differ from the workspace's, none of
            its robots has a name in the workspace's team, or it has no mission to learn from.
    """
    if earlier is None:
        return EarlierMissions()
    results = [earlier] if isinstance(earlier, Result) else earlier
    results = require_list("earlier", results, Result, _REMEDY)

    here = map_name(workspace)
    missions: list[Mission] = []
    planned: list[Planned] = []
    lost: list[LostMission] = []
    of_missions: list[_Source] = []
    of_lost: list[_Source] = []
    for k, result in enumerate(results):
        if any(result is other for other in results[:k]):
            continue
        what = "earlier" if result is earlier else f"earlier[{k}]"
        inherited = result.state.earlier
        found = _missions_of(result)
        _require_alike(what, result, found.missions, workspace)
        there = map_name(result.workspace)

        for mission in found.missions:
            on = mission.map or there
            mission = mission.in_order(mission.robots, workspace.features, ())
            missions.append(replace(mission, map="" if on == here else on))
        planned += found.planned
        of_missions += _sources(k, len(inherited.missions), len(found.missions))
        if there == here:
            lost += found.lost
            of_lost += _sources(k, len(inherited.lost), len(found.lost))

    alike = pooled(workspace.team.names, missions)
    kept = _without_repeats(alike, of_missions, Mission.has_same_data)
    of_lost_kept = _without_repeats(lost, of_lost, LostMission.__eq__)
    return EarlierMissions(
        tuple(alike[j] for j in kept),
        tuple(planned[j] for j in kept),
        tuple(lost[j] for j in of_lost_kept),
    )


def _missions_of(result: Result) -> EarlierMissions:
    """Return the missions of a result to learn from, starting with its own earlier ones."""
    state = result.state
    own = [entry for entry in state.entries if entry.exclusion is None]
    return EarlierMissions(
        (*state.earlier.missions, *(entry.mission for entry in own)),
        (*state.earlier.planned, *(planned_paths(entry.plan) for entry in own)),
        tuple(state.lost),
    )


def earlier_closings(
    earlier: Result | Sequence[Result] | None, workspace: Workspace
) -> tuple[Closing, ...]:
    """Return the closings of earlier campaigns on the same map that still count.

    A closing that ends with a mission lasts for as many missions as were left.
    """
    results = [earlier] if isinstance(earlier, Result) else earlier or []
    here = map_name(workspace)
    found: dict[Closing, None] = {}  # in order, each once
    for result in results:
        n_next = len(result.state.entries) + 1
        if map_name(result.workspace) != here:
            continue
        for closing in result.state.closings:
            if not closing.why_over(n_next):
                found[closing.after(n_next - 1)] = None
    return tuple(found)


class _Source(NamedTuple):
    """Origin of a mission.

    Attributes:
        result: Index of the result that contains it.
        is_inherited: Whether that campaign had taken it from a still earlier one.
    """

    result: int
    is_inherited: bool


def _sources(result: int, n_inherited: int, n: int) -> list[_Source]:
    """Return the origins of the n missions of a result, of which the first were inherited."""
    return [_Source(result, i < n_inherited) for i in range(n)]


def _without_repeats[T](
    missions: Sequence[T], sources: Sequence[_Source], is_same: Callable[[T, T], bool]
) -> list[int]:
    """Return indices of missions without those also in another result, because it inherited them.

    Missions of two campaigns that are equal by chance are both kept, if neither is inherited.
    """
    kept: list[int] = []
    matched: set[tuple[int, int]] = set()  # index of a mission that is kept, and of another result
    for i, (mission, source) in enumerate(zip(missions, sources, strict=True)):
        twin = None
        for j in kept:
            of_other = sources[j]
            is_possible = source.result != of_other.result and (j, source.result) not in matched
            is_shared = source.is_inherited or of_other.is_inherited
            if is_possible and is_shared and is_same(mission, missions[j]):
                twin = j
                break

        if twin is None:
            kept.append(i)
        else:
            matched.add((twin, source.result))
    return kept


def _require_alike(
    what: str, result: Result, missions: Sequence[Mission], workspace: Workspace
) -> None:
    """Raise TrustboError unless missions of a result can be fitted with those in a workspace."""
    if all(why_never_learned(mission) for mission in missions):
        raise TrustboError(f"{what} has no mission to learn from; leave it out.")

    own = result.workspace.features
    if sorted(own) != sorted(workspace.features):
        raise TrustboError(
            f"{what} has the features {joined(own)}, not {joined(workspace.features)}; make both "
            "workspaces with the same features."
        )

    robots = names_of_all(result.workspace.team.names, missions)
    if not set(robots) & set(workspace.team.names):
        raise TrustboError(
            f"{what} has the robots {joined(robots)}, and none of {joined(workspace.team.names)}; "
            "robots are matched by name, so name at least one of them alike."
        )
