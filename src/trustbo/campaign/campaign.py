"""A campaign: `ask` for a path, run it by any means, `tell` the mission."""

import time
import warnings
from collections.abc import Iterator, Sequence
from typing import Any, Self

import jax
import numpy as np
import pandas as pd
import xarray as xr
from jax import random

from trustbo.campaign.checks import require_extra, require_mission, require_reason, require_where
from trustbo.campaign.folder import STATE
from trustbo.campaign.history import history_of, table_of
from trustbo.campaign.learning import Learner
from trustbo.campaign.options import OBJECTIVE, POLICY, SAMPLER, CampaignOptions, arguments_of
from trustbo.campaign.planners import planner_given, planner_of, unpriced_risk
from trustbo.campaign.posteriors import Posterior, Posteriors, whole_posterior
from trustbo.campaign.result import Result
from trustbo.campaign.running import run_missions
from trustbo.campaign.state import SET_ASIDE, TOLD, CampaignState, Failure
from trustbo.campaign.stopping import Stop
from trustbo.campaign.storage import Storage
from trustbo.campaign.summary import evidence_of
from trustbo.data import Cell, Mission
from trustbo.display import Rows, Summary
from trustbo.errors import TrustboError, require_kind, require_whole
from trustbo.files import FilePath, as_path, interpreting
from trustbo.hazard.exposures import CAUSES
from trustbo.hazard.risk import BoundRisk
from trustbo.models.backend import VERSIONS
from trustbo.models.model import TrustModel
from trustbo.models.params import Params
from trustbo.models.record import model_from_record, model_to_record
from trustbo.planning import Plan, Planner, Policy
from trustbo.planning.policies import resolve_policy
from trustbo.simulation import Truth
from trustbo.simulation.protocol import Simulator
from trustbo.stacking import replace_awareness
from trustbo.workspace import Workspace
from trustbo.workspace.location import Location
from trustbo.workspace.moves import along, moves_along, require_on_grid


class Campaign(Summary):
    """Learns from missions and proposes the next path.

    A mission is planned by `ask`, then recorded, then learned from. One that cannot be learned from
    yet waits, and is tried with every later one; one that never can be is excluded. With a
    `directory`, every mission is on disk before anything is learned from it, and everything before
    the next is asked for: `Campaign.load` goes on where the process ended, with identical results.

    Attributes:
        workspace: Workspace of the paths.
        options: Options of the campaign.
        state: Missions as measured, their states, plans and posteriors, failures and notes.
        learner: Model, fit and hazard, and the current belief.
        planner: Planner on the workspace's awareness map; see `planner_now`.
        policy: Policy that chooses the paths.
        storage: Files of the campaign; None where it is in memory only.
        settings: Options and model, for `Result.settings`.
    """

    def __init__(
        self,
        workspace: Workspace,
        start: Location,
        goal: Location,
        *,
        model: TrustModel | None = None,
        policy: str | Policy = POLICY,
        objective: str = OBJECTIVE,
        sampler: str = SAMPLER,
        seed: int = 0,
        directory: FilePath | None = None,
        **options: Any,
    ) -> None:
        """Prepare a campaign; nothing is computed yet.

        Args:
            workspace: Workspace of the paths.
            start: First cell of every path, or a position in it; see `Workspace.locate`.
            goal: Last cell of every path, or a position in it.
            model: Trust model; by default `PooledTrust` with effects of places and robots.
            policy: Name of a policy, or a callable `policy(key, draws, planner) -> Plan`.
            objective: Objective of the paths; see `Planner`.
            sampler: Sampler of the posterior; see `trustbo.fit`.
            seed: Seed of everything random.
            directory: Folder that is updated after each mission. It is locked until the end of
                `with campaign:`, or of the process.
            **options: Fields of `CampaignOptions`, or a whole one as `options`.

        Raises:
            TrustboError: Start, goal or a name that does not exist; a sampler that does not suit
                the model; or a model that cannot be updated so.
            NoPathError: The goal cannot be reached.
        """
        self.options = CampaignOptions.from_keywords(options, Campaign.__init__)
        self.policy = resolve_policy(policy)
        require_kind("workspace", workspace, Workspace, "give a trustbo.Workspace")
        self.workspace = workspace
        self.state = CampaignState(require_whole("seed", seed, 0))
        self.learner = Learner(workspace, self.options, model, sampler, self.seed_of("prior"))
        model = self.model
        self.planner = planner_of(
            self.options, workspace, start, goal, objective, model.family.name
        )
        self.storage: Storage | None = None
        self._planner_now: Planner | None = None
        self._whole: tuple[Posterior, xr.DataTree] | None = None
        self._warned_of_risk = False
        self._asked = (0.0, 0.0)  # seconds that planning took, and the time when it was done
        name = getattr(policy, "__name__", type(policy).__name__)
        record = {
            "start": list(self.planner.start),
            "goal": list(self.planner.goal),
            "policy": policy if isinstance(policy, str) else name,
            "objective": objective,
            "sampler": sampler,
            "seed": self.state.seed,
        } | self.options.to_record()
        self.settings = record | {
            "model": model.named_with_effects,
            "observation": model.observation,
            "max_bounds": self.planner.max_bounds,
        }
        self.state.options = record | {
            "model": model_to_record(model),
            "own_policy": not isinstance(policy, str),
        }
        if directory is not None:
            self._save_to(Storage(directory), keep=True)

    def _rows(self) -> Rows:
        n, settings, state = len(self.missions), self.settings, self.state
        numbers = f"{n} told, {len(state.numbers(TOLD))} not learned from yet"
        others = {SET_ASIDE: len(state.numbers(SET_ASIDE)), "given up": len(state.failures)}
        numbers += "".join(f", {number} {name}" for name, number in others.items() if number)
        rows = [
            ("course", f"{tuple(settings['start'])} to {tuple(settings['goal'])}"),
            ("missions", numbers),
            ("model", self.model.in_short()),
            ("policy", f"{settings['policy']}, objective {settings['objective']}"),
        ]
        return rows + evidence_of(self.history)

    # --- ask and tell ---

    def run(
        self,
        simulator: Simulator | None = None,
        n_iterations: int = 8,
        *,
        truth: Truth | None = None,
        stop: Stop | Sequence[Stop] | None = None,
        progress: bool = False,
    ) -> Iterator[tuple[Plan, Mission]]:
        """Run missions in a simulator, one for each step of this iterator.

        Nothing is run until it is iterated over: `for plan, mission in campaign.run(simulator, 8)`.

        Args:
            simulator: Simulator, as in `iterate`.
            n_iterations: Largest number of missions in all.
            truth: Truth of the simulator, as in `iterate`.
            stop: Rules to end before `n_iterations`, as in `iterate`.
            progress: Progress to show, as in `iterate`.

        Yields:
            Plan of each mission, and the mission, learned from already.

        Raises:
            TrustboError: Bad input, before any work starts.
        """
        return run_missions(self, simulator, n_iterations, truth, stop, progress)

    def ask(self) -> Plan:
        """Plan the next path to run; the same one until `tell`, `fail` or `suggest`.

        Raises:
            TrustboError: The policy returned a path that is broken, or no plan.
        """
        if self.state.suggested is not None:
            return self.state.suggested
        started = time.perf_counter()
        planner = self.planner_now()
        with jax.threefry_partitionable(True):  # else the caller's flag decides what is drawn
            key = random.key(self.seed_of("policy"), impl="threefry2x32")
            plan = self.policy(key, self.belief, planner)
        name = f"the policy {self.settings['policy']!r}"
        if not isinstance(plan, Plan):
            raise TrustboError(f"{name} must return a Plan; got {plan!r}.")
        try:
            planner.require_path(plan.path)
        except TrustboError as error:
            raise TrustboError(f"{name}: {error}") from None
        return self._accept(plan, started)

    def suggest(self, path: Sequence[Cell]) -> Plan:
        """Let the operator choose the next path; `ask` then returns it.

        Args:
            path: Cells from start to goal.

        Raises:
            TrustboError: The path is broken, or does not lead from start to goal.
        """
        started = time.perf_counter()
        plan = self.planner_now().evaluate(path, self.belief.mean())
        return self._accept(plan, started)

    def _accept(self, plan: Plan, started: float) -> Plan:
        """Store a plan as the next one to run."""
        given = self.planner_now().evaluate(plan.path, self.belief)
        now = time.perf_counter()
        self._asked = now - started, now
        if plan.infeasible and plan.p_fail is not None:
            p_fail = 1.0 - np.prod(1.0 - plan.p_fail)  # by which max_failure goes
            warnings.warn(
                f"the plan fails with a chance of {p_fail:.3g}, bounds taken for independent, "
                f"beyond max_failure = {self.options.max_failure:g}; no safer path keeps within "
                "it, or none was found.",
                stacklevel=4,
            )
        if not self._warned_of_risk and (warning := unpriced_risk(self.options, self.risk, given)):
            self._warned_of_risk = True
            warnings.warn(warning, stacklevel=4)
        self.state.suggested = accepted = plan.with_draws(given)
        if self.storage is not None:
            self.storage.write(self.state, None)
        return accepted

    def tell(self, mission: Mission, **extra: float) -> xr.DataTree | None:
        """Record a mission and learn from it.

        It is learned from with the awareness of the map; with a belief about the awareness, with
        what robots measured, filled in from the belief.
        Robots and features may be in any order of their names. The path may differ from the one
        asked for.

        Args:
            mission: Mission as measured, whether or not the goal was reached.
            **extra: More numbers for its row of the history, such as its regret.

        Returns:
            Posterior of the parameters given all missions that can be learned from; with a warning
            the last one, or None, where this mission cannot be learned from yet, or never.

        Raises:
            ShapeError: Robots or features differ from the workspace's.
            TrustboError: The path leaves the grid, jumps or begins in another cell than the one
                asked for; or an extra is no number. Nothing is stored then.
        """
        mission = require_mission(mission, self.workspace, self.ask().path)
        self._take(mission, require_extra(extra))
        return self.state.last_tree

    def _take(self, mission: Mission, extra: dict[str, float]) -> None:
        """Write a mission to disk, then learn from it."""
        plan, trust_map, seed = self.ask(), self.trust_map(), self.seed_of("fit")
        learned = self.as_learned(mission)
        started = time.perf_counter()
        if self.storage is not None:
            extras = [*(entry.extra for entry in self.state.entries), extra]
            self.storage.write_measured([*self.state.measured, mission], extras)
        seconds = {"seconds_plan": self._asked[0], "seconds_run": started - self._asked[1]}
        entry = self.state.add(mission, learned, plan, trust_map, extra, **seconds)
        self.learner.take(self.state, seed)
        entry.row["seconds_fit"] = time.perf_counter() - started
        self._go_on()

    def _go_on(self) -> None:
        """Drop the plan that was run or given up, and write the new state."""
        self.state.suggested = self._planner_now = None
        if self.storage is not None:
            self.storage.write(self.state, self._result_so_far())

    def set_aside(self, reason: str, mission: int | None = None) -> xr.DataTree | None:
        """Exclude a mission from learning, for good; `tell` with the same mission adds it again.

        Args:
            reason: Reason, for the record.
            mission: Number of the mission, from 1; by default the last.

        Returns:
            Posterior of the parameters given the others; None if there is nothing to learn from.

        Raises:
            TrustboError: There is no such mission, or it is excluded already.
        """
        n = len(self.state.entries)
        number = n if mission is None else require_whole("mission", mission, 1)
        if not 1 <= number <= n:
            raise TrustboError(f"there is no mission {number} to set aside; {n} were told.")
        if (entry := self.state.entries[number - 1]).state == SET_ASIDE:
            raise TrustboError(f"mission {number} is set aside already: {entry.row['reason']}")
        entry.become(SET_ASIDE, str(reason))
        self.learner.learn(self.state, self.seed_of("fit"))
        self.state.suggested = self._planner_now = None
        if self.storage is not None:
            self.storage.write(self.state, self.result())
        return self.state.last_tree

    def fail(
        self,
        reason: str,
        mission: Mission | None = None,
        *,
        where: Cell | None = None,
    ) -> xr.DataTree | None:
        """Give up the mission that was asked for; the next plan takes it into account.

        Args:
            reason: Reason, for the record. One of `hazard.CAUSES`, such as "stuck", means that a
                bound of the plan failed, and is learned from as a hazard.
            mission: Bounds that were run, to learn from; None if there are none.
            where: Cell that it failed to enter, if that is certain though it did not report.

        Returns:
            Posterior of the parameters, if there was something to learn.

        Raises:
            TrustboError: The mission is one that `tell` refuses, or reached the goal in spite of
                a cause; a reason that is empty; or a `where` that the plan does not enter, together
                with a mission, or for another reason.
        """
        if mission is not None and where is not None:
            raise TrustboError(f"the mission tells where it failed; leave where = {where}.")
        require_reason(reason, mission)
        state, posterior, path = self.state, None, ()
        if mission is not None:
            posterior = self.tell(mission)
        elif where is not None or reason in CAUSES:
            path = self.ask().path
            where = None if where is None else require_where(where, reason, path)
        failure = Failure(len(state.entries), reason, tuple(path), where, mission is not None)
        state.failures.append(failure)
        self._go_on()
        return posterior

    def recommend(self) -> Plan:
        """Plan the best path under the mean of the belief, regardless of the policy."""
        return self.planner_now().plan(self.belief.mean())

    def trust_map(self) -> xr.DataArray:
        """Compute the team's trust map under the mean of the belief, dims (row, col)."""
        return self.planner_now().trust_map(self.belief.mean())

    def planner_now(self) -> Planner:
        """Planner with the current belief about the awareness, away from bounds that failed.

        A bound that failed twice is not entered again unless there is no other way, or its chance
        to fail fell below 0.2.
        """
        if self._planner_now is None:
            self._planner_now = planner_given(self.planner, self.learner, self.state)
        return self._planner_now

    def known_along(self, path: Sequence[Cell]) -> np.ndarray:
        """Awareness expected in the bounds of a path, shape (bound, robot, feature).

        It is that of the map, or of the belief after the missions so far; `TrustFilter` and
        missions use it where robots do not measure awareness.

        Args:
            path: Current cell of the team and the cells to be entered; need not begin at the start.

        Raises:
            TrustboError: A cell is off the grid, or no neighbour of the one before.
        """
        cells = require_on_grid(path, self.workspace.grid.shape)
        moves_along(cells)
        return np.swapaxes(along(self.workspace.bound_maps, cells), 0, 1)

    def as_learned(self, mission: Mission) -> Mission:
        """Return a mission with the awareness that it is learned from.

        It is the map's, which plans go by: weights fitted to what robots measured would be applied
        to other numbers, and plans be off by the difference.
        """
        return replace_awareness(mission, self.known_along(mission.path))

    # --- results ---

    def result(self) -> Result:
        """Collect everything learned so far, as `iterate` returns it.

        Raises:
            TrustboError: Nothing was learned yet.
        """
        if not self.state.entries:
            raise TrustboError("the campaign has no mission yet; tell it one first.")
        best = self.recommend()
        return Result(
            self.workspace, self.missions, self.posteriors, list(best.path), best.trust, best.value,
            self.trust_map(), self.history,
            {**self.settings, **self.state.notes, "trustbo_version": VERSIONS["trustbo"]},
            self.state.stop_reason, tuple(self.state.failures),
        )  # fmt: skip

    def _result_so_far(self) -> Result | None:
        return self.result() if self.state.entries else None

    def stop(self, reason: str) -> Result:
        """End the campaign, which may still go on later, and return its result.

        Args:
            reason: Reason, for `Result.stop_reason`.
        """
        self.state.stop_reason = reason
        result = self.result()
        if self.storage is not None:
            self.storage.write(self.state, result, ended=True)
        return result

    @property
    def missions(self) -> list[Mission]:
        """Missions recorded so far, their awareness filled in."""
        return self.state.missions

    @property
    def posteriors(self) -> Posteriors:
        """Posterior of the parameters after each mission; None where nothing was learned yet."""
        return self.state.posteriors

    @property
    def posterior(self) -> xr.DataTree | None:
        """Posterior after the last mission, with all groups; None before anything is learned."""
        last = self.state.last
        if last is None:
            return None
        if self._whole is None or self._whole[0] is not last:
            self._whole = last, whole_posterior(last(), self.missions, self.model)
        whole = self._whole[1]
        whole["hazard"] = xr.DataTree(self.hazard)
        return whole

    @property
    def history(self) -> xr.Dataset:
        """Dataset as `Result.history`; empty before the first mission."""
        return history_of(self.state.entries)

    def table(self) -> pd.DataFrame:
        """Table with a row for each mission, as `Result.table`."""
        return table_of(self.history, self.missions, self.state.failures)

    @property
    def model(self) -> TrustModel:
        """Trust model."""
        return self.learner.model

    @property
    def belief(self) -> Params:
        """Parameter draws of the next plan: the posterior's, or, at first, one from the prior."""
        return self.learner.belief

    @property
    def hazard(self) -> xr.Dataset:
        """Group `hazard` of the posterior, see `hazard.fit_hazard`; of the prior at first."""
        return self.learner.hazard(self.state)[0]

    @property
    def risk(self) -> BoundRisk:
        """Chances of the bounds to fail, of all missions so far."""
        return self.learner.hazard(self.state)[1]

    def seed_of(self, stream: str) -> int:
        """Seed of one stream of randomness ("policy", "fit", "mission") at this iteration."""
        return self.state.seed_of(stream)

    # --- the folder ---

    def save(self, directory: FilePath, *, keep: bool = False, overwrite: bool = False) -> None:
        """Write everything to a folder that `Campaign.load` reads.

        Args:
            directory: Folder to write to.
            keep: Whether to go on writing there after each mission, as with a `directory`, until
                the end of `with campaign:`.
            overwrite: Whether to remove another campaign or result in the folder first.

        Raises:
            TrustboError: The folder holds another campaign or result, without `overwrite`; another
                campaign has locked it; or its name belongs to a file.
        """
        storage, path = self.storage, as_path(directory).resolve()
        if storage is None or storage.path.resolve() != path:
            storage = Storage(directory, overwrite=overwrite)
        self._save_to(storage, keep)

    def _save_to(self, storage: Storage, keep: bool) -> None:
        before = self.storage
        try:
            storage.write_whole(self.workspace, self.state, self._result_so_far())
            if keep:
                self.storage = storage
        finally:
            for other in (before, storage):
                if other is not None and other is not self.storage:
                    other.release()

    @classmethod
    def load(
        cls,
        directory: FilePath,
        *,
        model: TrustModel | None = None,
        policy: Policy | None = None,
        **custom: Any,
    ) -> Self:
        """Go on with a campaign where it stopped, in the same folder.

        A mission that was recorded and not yet learned from is learned from now.

        Args:
            directory: Folder that was passed as `directory`, or to `save`.
            model: The same model, if it or its priors are custom.
            policy: The same policy, if it is custom.
            **custom: The same `callbacks`.

        Raises:
            TrustboError: There is no campaign; another process has locked it; or a custom object
                is missing.
        """
        storage = Storage(directory, begun=True)
        try:
            state, workspace, pending = storage.read()
            with interpreting(storage.path / STATE):
                given, kind = arguments_of(state.options, policy, **custom)
                restored = model_from_record(kind) if model is None else None
            # Not within: an error of the user's model is none of the file.
            restored = model_from_record(kind, model) if restored is None else restored
            campaign = cls(workspace, model=restored, **given)
            state.options = campaign.state.options  # as this version writes them
            campaign.state, campaign.storage = state, storage
            campaign.learner.restore(state)
            for mission, extra in pending:
                campaign._take(mission, extra)
        except BaseException:
            storage.release()
            raise
        return campaign

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        if self.storage is not None:
            self.storage.release()
            self.storage = None
