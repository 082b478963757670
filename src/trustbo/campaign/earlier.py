"""Missions of earlier campaigns, which are data of a new campaign.

By Bayes' rule, the posterior of an earlier campaign, taken as the prior of a new one, gives the
posterior given the missions of both. The earlier missions therefore enter every fit.
"""

import json
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import xarray as xr

from trustbo.campaign.learning import is_excluded_by_user, why_never_learned
from trustbo.campaign.state import EarlierMissions
from trustbo.data import Mission
from trustbo.display import joined
from trustbo.errors import TrustboError, require_list
from trustbo.files import to_json
from trustbo.hazard.trials import LostMission
from trustbo.logs.netcdf import missions_from_tree, missions_to_tree
from trustbo.stacking import names_of_all, pooled
from trustbo.workspace import Workspace
from trustbo.workspace.identity import map_name

if TYPE_CHECKING:
    from trustbo.campaign.result import Result

_REMEDY = "give a result or campaign, or a list of them"


def earlier_missions(
    earlier: "Result | Sequence[Result] | None", workspace: Workspace
) -> EarlierMissions:
    """Collect the missions of earlier campaigns for a campaign in a workspace.

    These are the missions that the campaigns used for learning, and those that they had taken from
    still earlier campaigns. Missions on the map of the workspace have the map "".

    Raises:
        TrustboError: An entry is not a result, its features differ from the workspace's, none of
            its robots has a name in the workspace's team, or it has no mission to learn from.
    """
    # Imported here because results have earlier missions themselves.
    from trustbo.campaign.result import Result

    if earlier is None:
        return EarlierMissions()
    results = [earlier] if isinstance(earlier, Result) else earlier
    results = require_list("earlier", results, Result, _REMEDY)

    here = map_name(workspace)
    missions: list[Mission] = []
    lost: list[LostMission] = []
    for k, result in enumerate(results):
        what = "earlier" if result is earlier else f"earlier[{k}]"
        found = _missions_of(result)
        _require_alike(what, result, found.missions, workspace)
        there = map_name(result.workspace)

        for mission in found.missions:
            on = mission.map or there
            mission = mission.in_order(mission.robots, workspace.features, ())
            missions.append(replace(mission, map="" if on == here else on))
        if there == here:
            lost += found.lost

    return EarlierMissions(tuple(pooled(workspace.team.names, missions)), tuple(lost))


def _missions_of(result: "Result") -> EarlierMissions:
    """Return the missions of a result to learn from, starting with its own earlier ones."""
    state = result.state
    own = [entry.mission for entry in state.entries if not is_excluded_by_user(entry)]
    return EarlierMissions((*state.earlier.missions, *own), tuple(state.lost))


def _require_alike(
    what: str, result: "Result", missions: Sequence[Mission], workspace: Workspace
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


def earlier_to_tree(earlier: EarlierMissions) -> xr.DataTree:
    """Convert earlier missions to a data tree."""
    tree = missions_to_tree(earlier.missions)
    tree.attrs["lost"] = to_json([mission._asdict() for mission in earlier.lost])
    return tree


def earlier_from_tree(tree: xr.DataTree) -> EarlierMissions:
    """Restore earlier missions from a data tree made by `earlier_to_tree`."""
    lost = []
    records: list[dict[str, Any]] = json.loads(tree.attrs["lost"])
    for record in records:
        path = tuple((row, col) for row, col in record["path"])
        where = record["where"]
        lost.append(LostMission(path, None if where is None else tuple(where)))
    return EarlierMissions(tuple(missions_from_tree(tree)), tuple(lost))
