"""Learning from missions: the posterior of trust and the hazard."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from trustbo.campaign.state import (
    Planned,
    Posterior,
    State,
    planned_paths,
    why_never_learned,
)
from trustbo.data import OF_BOUNDS, Cell, Mission, Station, cells_of
from trustbo.errors import PosteriorError, TrustboError, warn
from trustbo.hazard import Hazard
from trustbo.hazard.model import fit_hazard
from trustbo.hazard.trials import CAUSES
from trustbo.inference.diagnostics import diagnostics
from trustbo.inference.fit import fit
from trustbo.inference.learns import Learner
from trustbo.inference.tree import parameters_alone
from trustbo.stacking import pooled
from trustbo.workspace import Workspace

AWARENESS = ("map", "measured")
"""Sources of awareness from which a campaign learns."""


def as_learned(mission: Mission, workspace: Workspace, awareness: str) -> Mission:
    """Return a mission with the awareness from which a campaign learns.

    The result has all robots of the workspace. Those that stayed at home have no rates, and the
    awareness of the map, since the noise of rates depends on the line of sight of the whole team.

    Args:
        mission: Mission with the awareness that was measured, NaN where it was not, by the robots
            that took part.
        workspace: Workspace of the mission.
        awareness: `"map"` for the awareness of the map, which the planner also uses; `"measured"`
            for the measured awareness. Where this source is NaN, the other one is used.

    Raises:
        TrustboError: The path leaves the grid or skips cells.
    """
    try:
        of_team = workspace.along(mission.stations, anywhere=True)[: len(mission.bounds)]
    except TrustboError as error:
        if any(status != "ok" for status in mission.bound_status[:-1]):
            raise TrustboError(
                f"{error} A lead that did not reach the cell of a bound that failed has to drive a "
                "bound back before the next one."
            ) from None
        raise

    team = workspace.team.names
    known = of_team[:, [team.index(name) for name in mission.robots]]
    measured = mission.awareness
    first, second = (measured, known) if awareness == "measured" else (known, measured)
    learned = mission.with_awareness(np.where(np.isnan(first), second, first))
    if mission.robots == team:
        return learned

    whole = learned.with_robots(team)
    went = np.isin(team, mission.robots)[:, None]
    return whole.with_awareness(np.where(went, whole.awareness, of_team))


def with_cause(mission: Mission, cause: str) -> tuple[Mission, str]:
    """Return a mission whose failures say nothing about other bounds, and a text of their cause.

    Bounds that failed become aborted ones. Without a cause, the mission is returned unchanged.

    Raises:
        TrustboError: The cause is not a text, or no bound failed.
    """
    if not isinstance(cause, str):
        raise TrustboError(f"cause must be a text such as 'mud'; got {cause!r}.")
    if not cause.strip():
        return mission, ""

    failed = [status for status in mission.statuses if status in CAUSES]
    if not failed:
        raise TrustboError(f"cause = {cause!r} is given, but no bound failed; leave it out.")
    statuses = tuple("aborted" if one in CAUSES else one for one in mission.bound_status)
    status = "aborted" if mission.status in CAUSES else mission.status
    text = f"{cause.strip()} ({', '.join(dict.fromkeys(failed))})"
    return replace(mission, bound_status=statuses, status=status), text


def require_new(state: State, mission: Mission) -> None:
    """Raise TrustboError if a mission with the same data is recorded and not excluded."""
    has_failed = any(status != "ok" for status in mission.statuses)
    if not has_failed and not np.isfinite(mission.contact_rate).any():
        return  # without rates and failures, missions on the same path are alike

    for n, entry in enumerate(state.entries, start=1):
        if entry.measured.has_same_data(mission) and entry.exclusion is None:
            raise TrustboError(
                f"mission {n} has the same data, so this mission is recorded already. If it is "
                "another mission, call tell(mission, again=True)."
            )


def with_posterior(
    state: State, learner: Learner, workspace: Workspace, hazard: xr.Dataset, progress: bool
) -> State:
    """Return a state whose posterior is that of the missions that are used.

    If no mission is used, it is that of the earlier missions, if there are any. If the fit fails,
    the last posterior remains, and the new state contains the reason.

    Args:
        state: State of the campaign.
        learner: The model, as campaigns use it.
        workspace: Workspace of the campaign.
        hazard: Group `hazard` of the posterior.
        progress: Whether to show a progress bar.
    """
    used = state.used
    posterior = None if used else state.initial
    if posterior is None and (used or state.earlier.missions):
        try:
            posterior = _fitted(state, learner, workspace, hazard, progress)
        except TrustboError as error:
            return replace(state, fitted=used, why_not=getattr(error, "reason", str(error)))
        except Exception as error:  # a bug must not lose a recorded mission
            if isinstance(error.__cause__, KeyboardInterrupt):  # numba wraps it
                raise error.__cause__ from None
            return replace(state, fitted=used, why_not=f"{type(error).__name__}: {error}")

    entries = state.entries
    if entries:
        entries = (*entries[:-1], replace(entries[-1], posterior=posterior))
    initial = state.initial if used else posterior
    return replace(state, entries=entries, initial=initial, fitted=used, why_not="")


def _fitted(
    state: State, learner: Learner, workspace: Workspace, hazard: xr.Dataset, progress: bool
) -> Posterior:
    """Fit the posterior of the parameters to all missions that are not excluded.

    Missions of earlier campaigns come first. The attribute `missions` of the posterior lists the
    indices of the missions, which are negative for earlier campaigns.
    """
    used = state.used
    earlier = usable(state.earlier.missions)
    whole = fit(
        [state.entries[j].mission for j in used],
        learner.known,
        workspace=workspace,
        sampler=state.settings["sampler"],
        seed=state.seed_of_fit,
        progress=progress,
        start=_previous(state),
        earlier=earlier,
        latent=False,
        **state.settings["fit"],
    )
    tree = parameters_alone(whole)
    tree.attrs["missions"] = [*range(-len(earlier), 0), *used]
    tree["hazard"] = xr.DataTree(hazard)

    n_excluded = len(state.entries) - len(used)
    name = f"{len(state.entries):04d}-{n_excluded}" if n_excluded else f"{len(state.entries):04d}"
    return Posterior(name if used else "0000", used, diagnostics(tree), tree)


def usable(missions: Sequence[Mission]) -> list[Mission]:
    """Return the missions from which trust can be learned."""
    return [mission for mission in missions if not why_never_learned(mission)]


def fitted_missions(state: State, labels: Sequence[int]) -> list[Mission]:
    """Return the missions in a fit by their indices; earlier ones are -n, ..., -1."""
    earlier = usable(state.earlier.missions)
    own = [state.entries[j].mission for j in labels if j >= 0]
    n_earlier = sum(j < 0 for j in labels)
    missions = [*earlier[len(earlier) - n_earlier :], *own]
    return pooled(missions[0].robots, missions)


def _previous(state: State) -> xr.DataTree | None:
    """Return the last posterior, or None if there is none or its file cannot be read."""
    try:
        return state.posterior
    except TrustboError:
        return None


def learn_hazard(state: State, workspace: Workspace, so_far: Mission | None = None) -> xr.Dataset:
    """Fit the failure probabilities of bounds to all missions; see `fit_hazard`.

    Missions that cannot be used for learning trust are included, because they show where the team
    failed. Missions of earlier campaigns on the same map and the bounds `so_far` of a mission in
    progress are included as well. If the diagnostics fail, the previous posterior is returned with
    a warning.
    """
    measured = missions_of_hazard(state, so_far)
    missions = [one.mission for one in measured]
    goals = [one.goal for one in measured]
    prior = Hazard(**state.settings["hazard"])
    seed = state.seed_of("hazard")
    try:
        return fit_hazard(missions, workspace, prior, lost=state.lost, goals=goals, seed=seed)
    except PosteriorError as error:
        warn(f"{error} The campaign uses the previous hazard posterior.")

    last = state.posterior
    if last is not None:
        return last["hazard"].to_dataset()
    return fit_hazard([], workspace, prior)


class Tried(NamedTuple):
    """Mission, or a part of it, from which the hazard is learned.

    Attributes:
        number: Number of the mission in `Result.table`; None for missions of earlier campaigns.
        mission: Bounds that were run, with the cells that were planned after them.
        goal: Last cell of the planned path; None if it is not known.
    """

    number: int | None
    mission: Mission
    goal: Cell | None


def missions_of_hazard(state: State, so_far: Mission | None = None) -> list[Tried]:
    """Return the measured missions from which the hazard is learned.

    A mission in progress comes last. A mission that was replanned after a failure has several
    parts; see `_parts`.
    """
    measured = []
    earlier = state.earlier
    for mission, planned in zip(earlier.missions, earlier.planned, strict=True):
        if not mission.map:
            measured += _tried(None, mission, planned)

    for number, entry in enumerate(state.entries, start=1):
        if entry.exclusion is None:
            measured += _tried(number, entry.measured, planned_paths(entry.plan))

    if so_far is not None:
        planned = () if state.asked is None else planned_paths(state.asked)
        measured += _tried(len(state.entries) + 1, so_far, planned)
    return measured


def _tried(number: int | None, mission: Mission, planned: Planned) -> list[Tried]:
    """Return the parts of a mission, given its planned paths."""
    if not planned:
        return [Tried(number, mission, None)]
    goal = planned[0][-1][:2]
    return [Tried(number, part, goal) for part in _parts(mission, planned)]


def _parts(mission: Mission, planned: Planned) -> list[Mission]:
    """Split a mission where a bound failed and it was replanned, and add the planned cells.

    Each part ends with the cells that were planned when its last bound failed. The way back from a
    bound that failed belongs to no part if it was completed, as in `Trials`.
    """
    last, *abandoned = planned
    parts = []
    first = 0  # bound with which the next part begins
    for path in abandoned:
        cells = cells_of(path)
        failed = next((k for k in range(first, len(mission.statuses)) if _failed(mission, k)), None)
        if failed is None or cells[: failed + 2] != [*mission.path[: failed + 2]]:
            continue

        part = _some_bounds(mission, first, failed + 1, mission.statuses[failed])
        rest = (*mission.stations[first : failed + 1], *path[failed + 1 :])
        parts.append(_on(part, rest))

        first = failed + 1
        is_back = mission.path[first + 1 : first + 2] == (cells[failed],)
        if is_back and not _failed(mission, first):
            first += 1

    if first == 0:
        return [_with_planned_path(mission, last)]
    if first < len(mission.statuses):
        rest = _some_bounds(mission, first, len(mission.statuses), mission.status)
        parts.append(_with_planned_path(rest, last[first:]))
    return parts


def _failed(mission: Mission, k: int) -> bool:
    """Return whether a bound of a mission was begun and not completed."""
    return k < len(mission.statuses) and mission.statuses[k] != "ok"


def _on(mission: Mission, stations: Sequence[Station], **fields: Any) -> Mission:
    """Return a mission on another path, whose sets of posts are those of the stations."""
    return replace(mission, path=stations, post_sets=(), **fields)


def _some_bounds(mission: Mission, begin: int, end: int, status: str) -> Mission:
    """Return some bounds of a mission, with the cells that the mission has planned after them."""
    of_bounds = {name: getattr(mission, name)[begin:end] for name in OF_BOUNDS}
    return _on(mission, mission.stations[begin:], status=status, **of_bounds)


def _with_planned_path(mission: Mission, path: Sequence[Station]) -> Mission:
    """Add the planned cells to the path of a mission that ends where its log ends.

    The failure probability of a bound depends on the next move and on the set of posts that the
    plan has for it, which are then known.
    """
    n = len(mission.path)
    is_begun = all(a[:2] == b for a, b in zip(path, mission.path, strict=False))
    if mission.status == "ok" or len(path) <= n or not is_begun:
        return mission
    return _on(mission, (*mission.stations[:-1], *path[n - 1 :]))
