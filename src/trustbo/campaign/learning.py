"""Learning from missions: the posterior, the hazard, and the planner of the next path."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import xarray as xr

from trustbo.campaign.state import EXCLUDED, LEARNED, TOLD, Entry, State
from trustbo.data import Mission
from trustbo.errors import PosteriorError, TrustboError, warn
from trustbo.hazard import Hazard
from trustbo.hazard.model import fit_hazard
from trustbo.hazard.risk import BoundRisk
from trustbo.inference.learner import Learner
from trustbo.models.draws import Draws
from trustbo.planning import Plan, Planner
from trustbo.stacking import pooled
from trustbo.workspace import Workspace

_STOPPED = 2
"""Number of failures after which a bound is avoided."""
_RECOVERED = 0.2
"""Failure probability below which such a bound is allowed again."""
_ROUNDING = 1e-9
"""Largest rounding error of an expected number of failures."""
_HOPELESS = 0.9
"""Failure probability of the best path above which the safest path is planned instead."""


AWARENESS = ("map", "measured")
"""Sources of awareness from which a campaign learns."""


def as_learned(mission: Mission, workspace: Workspace, awareness: str) -> Mission:
    """Return a mission with the awareness from which a campaign learns.

    Args:
        mission: Mission with the awareness that was measured, NaN where it was not.
        workspace: Workspace of the mission.
        awareness: `"map"` for the awareness of the map, which the planner also uses; `"measured"`
            for the measured awareness. Where this source is NaN, the other one is used.

    Raises:
        TrustboError: The path leaves the grid or skips cells.
    """
    try:
        known = workspace.along(mission.path, anywhere=True)[: len(mission.bounds)]
    except TrustboError as error:
        if any(status != "ok" for status in mission.bound_status[:-1]):
            raise TrustboError(
                f"{error} A lead that did not reach the cell of a bound that failed has to drive a "
                "bound back before the next one."
            ) from None
        raise

    measured = mission.awareness
    first, second = (measured, known) if awareness == "measured" else (known, measured)
    return mission.with_awareness(np.where(np.isnan(first), second, first))


def why_never_learned(mission: Mission) -> str:
    """Return why a mission can never be used for learning, or an empty string."""
    if not np.isfinite(mission.contact_rate).any():
        return "no contact rate was measured."
    if np.isnan(mission.awareness).any():
        k = int(np.argwhere(np.isnan(mission.awareness))[0, 0])
        return f"the map has no awareness in cell {mission.bounds[k].cell} of bound {k + 1}."
    return ""


def add_entry(state: State, entry: Entry) -> None:
    """Add a mission that is on disk to a state, and mark the fit as due."""
    entry.posterior = state.last
    seed = state.seed_of("fit")
    state.asked = None
    state.entries.append(entry)

    reason = why_never_learned(entry.mission)
    if reason:
        entry.become(EXCLUDED, reason)
    else:
        state.due = seed


def is_excluded_by_user(entry: Entry) -> bool:
    """Return whether a mission was excluded for another reason than `why_never_learned`."""
    own = why_never_learned(entry.mission) or None
    return entry.row["state"] == EXCLUDED and entry.row["reason"] != own


def learn(
    state: State, learner: Learner, workspace: Workspace, seed: int, progress: bool
) -> tuple[xr.DataTree | None, str]:
    """Fit the posterior of the parameters to all missions that are not excluded.

    Missions of earlier campaigns come first. The attribute `missions` of the posterior lists the
    indices of the missions, which are negative for earlier campaigns. The state does not change.

    Returns:
        The posterior and an empty text; or, if the fit fails, None and the reason.
    """
    used = state.indices(TOLD, LEARNED)
    missions = [state.entries[j].mission for j in used]
    try:
        tree = learner.fit(
            missions,
            workspace=workspace,
            sampler=state.settings["sampler"],
            seed=seed,
            progress=progress,
            start=_previous(state),
            earlier=usable(state.earlier.missions),
            **state.settings["fit"],
        )
    except TrustboError as error:
        return None, getattr(error, "reason", str(error))
    except Exception as error:  # a bug must not lose a recorded mission
        if isinstance(error.__cause__, KeyboardInterrupt):  # numba wraps it
            raise error.__cause__ from None
        return None, f"{type(error).__name__}: {error}"

    tree.attrs["missions"] = labels_of(state, used)
    return tree, ""


def usable(missions: Sequence[Mission]) -> list[Mission]:
    """Return the missions from which trust can be learned."""
    return [mission for mission in missions if not why_never_learned(mission)]


def labels_of(state: State, used: Sequence[int]) -> list[int]:
    """Return the indices of all missions in a fit: earlier ones are -n, ..., -1."""
    return [*range(-len(usable(state.earlier.missions)), 0), *used]


def fitted_missions(state: State, labels: Sequence[int]) -> list[Mission]:
    """Return the missions in a fit by their indices; see `labels_of`."""
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
    measured = [mission for _, mission in missions_of_hazard(state, so_far)]
    prior = Hazard(**state.settings["hazard"])
    seed = state.seed_of("hazard")
    goal = tuple(state.settings["goal"])
    try:
        return fit_hazard(measured, workspace, prior, lost=state.lost, goal=goal, seed=seed)
    except PosteriorError as error:
        warn(f"{error} The campaign uses the previous hazard posterior.")

    last = state.posterior
    if last is not None:
        return last["hazard"].to_dataset()
    return fit_hazard([], workspace, prior)


def missions_of_hazard(
    state: State, so_far: Mission | None = None
) -> list[tuple[int | None, Mission]]:
    """Return the measured missions from which the hazard is learned, with their numbers.

    The numbers are those of `Result.table`; missions of earlier campaigns have none. A mission in
    progress comes last. See `learn_hazard`.
    """
    measured: list[tuple[int | None, Mission]] = [
        (None, mission) for mission in state.earlier.missions if not mission.map
    ]
    for number, entry in enumerate(state.entries, start=1):
        if not is_excluded_by_user(entry):
            measured.append((number, _with_planned_path(entry.measured, entry.plan)))
    if so_far is not None:
        plan = state.asked
        mission = so_far if plan is None else _with_planned_path(so_far, plan)
        measured.append((len(state.entries) + 1, mission))
    return measured


def _with_planned_path(mission: Mission, plan: Plan) -> Mission:
    """Add the planned cells to the path of a mission that ends where its log ends.

    The failure probability of a bound depends on the next move, which is then known.
    """
    n = len(mission.path)
    if mission.status == "ok" or len(plan.path) <= n or plan.path[:n] != mission.path:
        return mission
    return replace(mission, path=plan.path)


def informed_planner(planner: Planner, risk: BoundRisk) -> Planner:
    """Make a planner that accounts for the failure probabilities of bounds.

    A bound that failed twice is avoided unless there is no other path, or its failure probability
    has fallen below 0.2. If failures have a cost, a bound is avoided only if this applies with all
    of its next moves, because the search accounts for the others by their cost.

    Before the first failure, the user's slope limit is trusted, and failures have no cost unless
    the user gave `failure_cost`. Under the prior alone, a cost would rule out longer paths that
    keep contact and never fail. The cost is computed jointly over components of the hazard
    posterior, because all bounds share the slope limit.
    """
    if planner.problem.failure_cost is None and not risk.has_failures:
        planner = planner.with_failure_cost(0.0)

    planner = planner.with_risk(risk)
    problem = planner.problem
    priced = problem.objective.of_contact and problem.failure_cost != 0.0
    n_stopped = risk.past_failures if priced else risk.past_failures_of_bounds[..., None]
    stopped = n_stopped + _ROUNDING >= _STOPPED
    if not stopped.any():
        return planner

    is_likely = ~(risk.mean < _RECOVERED)
    if priced:
        stopped &= is_likely
        avoided = stopped.any(-1) & (stopped | ~risk.exists).all(-1)
    else:
        avoided = stopped.any(-1) & (is_likely & risk.exists).any(-1)
    if not avoided.any():
        return planner
    return planner.avoiding(avoided, np.nanmax(risk.mean, axis=-1, initial=0.0))


def instead_of_failure(planner: Planner, plan: Plan, draws: Draws) -> Plan:
    """Return the plan, or the safest one if the plan almost certainly fails.

    If all paths are likely to fail, their costs of failure are nearly equal, so that the plan would
    minimise lost contact again. This function has an effect only if failures have a cost.

    Args:
        planner: Planner of `informed_planner`.
        plan: Plan of a policy.
        draws: Parameter draws, under whose mean the safest path is evaluated.
    """
    problem = planner.problem
    if problem.risk is None or not problem.cost_of_failure:
        return plan
    if problem.risk.failure(plan.path) <= _HOPELESS:
        return plan

    path, _ = problem.safest()
    return planner.evaluate(path, draws.mean())
