"""Campaign with an ask/tell interface: `ask` for a path, drive it, and `tell` the mission."""

import inspect
import json
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from functools import cached_property
from typing import Any, Self

import numpy as np
import xarray as xr

from trustbo.campaign.learning import as_learned, is_excluded_by_user, learn, why_never_learned
from trustbo.campaign.result import Result, in_a_line
from trustbo.campaign.state import EXCLUDED, LEARNED, TOLD, Entry, Failure, Posterior, State
from trustbo.campaign.stopping import Stop
from trustbo.campaign.storage import Storage, read_campaign, require_campaign
from trustbo.data import Cell, Mission
from trustbo.display import compiling, tqdm
from trustbo.errors import TrustboError, require_choice, require_kind, require_pair, require_whole
from trustbo.files import FilePath, to_json
from trustbo.hazard import Hazard
from trustbo.hazard.exposures import CAUSES
from trustbo.inference.diagnostics import diagnostics
from trustbo.inference.fit import SAMPLERS, fit
from trustbo.models import HumanTrust, default_model
from trustbo.models.model import TrustModel
from trustbo.models.record import model_from_record, model_to_record
from trustbo.planning import InfeasibleError, Plan, Planner
from trustbo.planning.policies import POLICIES, Policy, resolve_policy
from trustbo.simulation import KinematicSimulator
from trustbo.simulation.protocol import Simulator
from trustbo.workspace import Workspace
from trustbo.workspace.grid import Location

_OPTIONS = ("objective", "sampler", "seed", "initial", "planner", "fit")
"""Arguments of `Campaign` that are stored unchanged in the settings."""
_FIT = inspect.signature(fit)


class Campaign(Result):
    """Campaign that learns from missions and proposes the next path (ask/tell interface).

    `ask` plans a path, and `tell` records the mission on this path and learns from it. With a
    `directory`, each mission is written to disk before the posterior is updated, and
    `Campaign.load` continues after a crash with identical results.

    Attributes:
        policy: Policy that chooses the paths.
        storage: Folder of the campaign; None if it is in memory only.

    Example:
        >>> with tb.Campaign(workspace, (9, 0), (0, 9), directory="field") as campaign:
        ...     campaign.tell(drive(campaign.ask().path))  # your robots
    """

    def __init__(
        self,
        workspace: Workspace,
        start: Location,
        goal: Location,
        *,
        model: TrustModel | None = None,
        policy: str | Policy = "greedy",
        objective: str = "lost_contact",
        sampler: str = "importance",
        seed: int = 0,
        directory: FilePath | None = None,
        overwrite: bool = False,
        initial: str = "prior_mean",
        hazard: Hazard | None = None,
        planner: Mapping[str, Any] | None = None,
        fit: Mapping[str, Any] | None = None,
    ) -> None:
        """Check the arguments and prepare the campaign; no path is planned yet.

        Args:
            workspace: Workspace of the paths.
            start: First cell of every path, or a position in this cell; see `Workspace.locate`.
            goal: Last cell of every path, or a position in this cell.
            model: Trust model; by default `models.default_model()`, with place and robot effects.
            policy: Name in `planning.POLICIES`, or a callable `policy(rng, draws, planner)` that
                returns a Plan.
            objective: Objective of the paths; see `planning.Planner`.
            sampler: Sampler of the posterior; see `trustbo.fit`.
            seed: Seed of all random numbers.
            directory: Folder that is updated after each mission. It stays locked until the
                `with campaign:` block exits or the process ends.
            overwrite: Whether to replace an existing campaign in that folder.
            initial: Parameters for the first plan: `"prior_mean"`, or `"prior_draw"` for one random
                draw from the prior, as in the paper.
            hazard: Priors of the probability that a bound fails; by default `Hazard()`.
            planner: Further options of `planning.Planner`, such as `{"max_failure": 0.1}`. Failures
                have no cost until the first one is recorded, unless `failure_cost` is given.
            fit: Further options of `trustbo.fit`, such as `{"draws": 500}`.

        Raises:
            TrustboError: The start or goal is not a passable cell, a name is unknown, the sampler
                does not support the model, or the folder already contains a campaign.
            NoPathError: The goal cannot be reached.
        """
        require_kind("workspace", workspace, Workspace, "give a trustbo.Workspace")
        require_choice("initial", initial, ("prior_mean", "prior_draw"))
        require_choice("sampler", sampler, SAMPLERS)
        hazard = Hazard() if hazard is None else hazard
        require_kind("hazard", hazard, Hazard, "give a trustbo.hazard.Hazard")
        own = {"workspace": workspace, "seed": seed, "progress": True, "whole": False}
        _FIT.bind([], model, sampler=sampler, **own, **(fit or {}))  # TypeError if one is unknown
        model = default_model() if model is None else model
        require_kind("model", model, TrustModel, "give a trust model, such as PooledTrust()")
        if isinstance(model, HumanTrust):
            raise TrustboError("model: HumanTrust cannot plan paths; give PooledTrust() instead.")
        self.policy, options = resolve_policy(policy), dict(planner or {})
        base = Planner(workspace, start, goal, objective, family=model.observation, **options)
        settings = {
            "start": base.start,
            "goal": base.goal,
            "max_bounds": base.max_bounds,
            "policy": policy if isinstance(policy, str) else f"{_name_of(policy)} (custom)",
            "objective": objective,
            "sampler": sampler,
            "seed": require_whole("seed", seed, 0),
            "initial": initial,
            "planner": options,
            "fit": dict(fit or {}),
            "hazard": asdict(hazard),
            "observation": model.observation,
            "model": model.in_short(),
            "model_record": model_to_record(model),
        }
        state = State(json.loads(to_json(settings)))  # as if read from a file
        super().__init__(workspace, state, model, base)
        self._progress = True  # of fits
        self.storage: Storage | None = None
        if directory is not None:
            self.storage = Storage.begin(directory, workspace, self.state, overwrite=overwrite)

    def _renew(self) -> None:
        """Discard the plan and cached properties before the missions or failures change."""
        if self.storage is not None:
            self.storage.locked()  # raises TrustboError if the campaign is closed
        self.state.asked = None
        for name, of in vars(Result).items():
            if isinstance(of, cached_property):
                vars(self).pop(name, None)

    def ask(self) -> Plan:
        """Plan the next path; further calls return the same plan until `tell`, `fail` or `suggest`.

        Raises:
            TrustboError: The policy did not return a plan, or its path is invalid.
        """
        if self.state.asked is not None:
            return self.state.asked
        name = f"policy {self.state.settings['policy']!r}"
        rng = np.random.default_rng(self.state.seed_of("policy"))
        try:
            plan = self.policy(rng, self.belief, self.planner)
        except InfeasibleError as error:  # `_accept` issues the warning
            plan = self.planner.evaluate(error.path, self.belief.mean())
        require_kind(name, plan, Plan, "a policy must return a trustbo.planning.Plan")
        try:
            self.planner.require_path(plan.path)
        except TrustboError as error:
            raise TrustboError(f"{name}: {error}") from None
        return self._accept(plan)

    def suggest(self, path: Sequence[Cell]) -> Plan:
        """Set the next path manually; `ask` then returns it.

        Args:
            path: Cells from start to goal.

        Raises:
            TrustboError: The path is invalid, or does not lead from start to goal.
        """
        return self._accept(self.planner.evaluate(path, self.belief.mean()))

    def _accept(self, plan: Plan) -> Plan:
        """Add posterior bands to a plan, and store it as the next plan to run."""
        accepted = plan.with_draws(self.planner.evaluate(plan.path, self.belief))
        if plan.infeasible:
            warnings.warn(
                f"the plan arrives with probability {accepted.p_arrive:.3g} only, and max_failure "
                "does not allow this. Suggest a safer path, or increase max_failure.",
                stacklevel=3,
            )
        self.state.asked = accepted
        self._write()
        return accepted

    def tell(self, mission: Mission) -> xr.DataTree | None:
        """Record a mission and learn from it.

        For learning, the awareness of the map replaces the measured awareness. Robots and features
        may be in any order, and the path may differ from the planned path.

        Args:
            mission: Measured mission, whether or not it reached the goal.

        Returns:
            Posterior of the parameters given all usable missions. If this mission cannot be used
            (yet), a warning is issued, and the previous posterior or None is returned.

        Raises:
            TrustboError: The robots or features differ from the workspace's, or the path leaves
                the grid, skips cells, or does not begin at the start of the plan. The mission is
                then not stored.
        """
        require_kind("mission", mission, Mission, "give one trustbo.Mission at a time")
        mission, state, plan = self.workspace.in_order(mission), self.state, self.ask()
        if mission.path[0] != plan.path[0]:
            raise TrustboError(
                f"the mission starts in cell {mission.path[0]}; it must start in {plan.path[0]}."
            )
        learned = as_learned(mission, self.workspace)
        entry = Entry(plan, mission, learned, self.trust_map, state.row_of(plan, mission))
        if self.storage is not None:
            self.storage.add_mission(len(state.entries) + 1, entry)
        self._add(entry)
        return state.posterior

    def _add(self, entry: Entry) -> None:
        """Add a recorded mission to the state, and learn from it."""
        state, seed = self.state, self.state.seed_of("fit")
        entry.posterior = state.last
        self._renew()
        state.entries.append(entry)
        if reason := why_never_learned(entry.mission):
            entry.become(EXCLUDED, reason)
            warnings.warn(f"mission {len(state.entries)} is excluded: {reason}", stacklevel=3)
        else:
            self._learn(seed)
        self._write()

    def _learn(self, seed: int) -> None:
        """Fit the posterior after the last mission to all missions that are not excluded."""
        state, entry = self.state, self.state.entries[-1]
        if not (n_used := len(state.indices(TOLD, LEARNED))):
            entry.posterior = None
            return
        tree = learn(state, self.model, self.workspace, seed, self._progress)
        if tree is None:
            return
        tree["hazard"] = xr.DataTree(self.hazard)
        entry.row |= diagnostics(tree)
        n_excluded = len(state.entries) - n_used
        name = f"{len(state.entries):04d}" + (f"-{n_excluded}" if n_excluded else "")
        file = None if self.storage is None else self.storage.add_posterior(name, tree)
        if state.last is not None and state.last.file is not None:
            state.last.tree = None  # frees the memory
        entry.posterior = Posterior(name, tree, file)

    def _write(self) -> None:
        if self.storage is not None:
            self.storage.write_record(self.state)

    def exclude(self, n: int, reason: str) -> xr.DataTree | None:
        """Exclude a mission from learning; to use it again, pass the mission to `tell`.

        Args:
            n: Number of the mission, from 1.
            reason: Reason to store in the table of missions.

        Returns:
            Posterior of the parameters given the other missions; None if there are none. If it
            cannot be computed, a warning is issued, and the previous posterior is returned.

        Raises:
            TrustboError: There is no such mission, or it is already excluded by a user.
        """
        if require_whole("n", n, 1) > (n_told := len(self.state.entries)):
            raise TrustboError(f"there is no mission {n} to exclude; the last is mission {n_told}.")
        if is_excluded_by_user(entry := self.state.entries[n - 1]):
            raise TrustboError(f"mission {n} is already excluded: {entry.row['reason']}")
        self._renew()
        entry.become(EXCLUDED, str(reason))
        self._learn(self.state.seed_of("fit"))
        self._write()
        return self.state.posterior

    def fail(self, reason: str, *, where: Cell | None = None) -> None:
        """Report that no bound of the planned mission was measured; `ask` then plans again.

        If bounds were run, `tell` a mission with these bounds and its status instead.

        Args:
            reason: Reason to store in the table of missions. Only a reason in `hazard.CAUSES`, such
                as "stuck", means that a bound of the plan failed, and is used to learn the hazard.
            where: Cell that the team failed to enter, if known.

        Raises:
            TrustboError: The reason is empty, the plan does not enter `where`, or `where` is given
                but the reason is not in `hazard.CAUSES`.
        """
        if not isinstance(reason, str) or not reason.strip():
            raise TrustboError(f"reason must be a text such as {CAUSES[0]!r}; got {reason!r}.")
        path = self.ask().path if reason in CAUSES or where is not None else ()
        where = None if where is None else require_pair("where", where)
        if where is not None and (reason not in CAUSES or where not in path[1:]):
            raise TrustboError(
                f"where = {where} must be a cell that the plan enters, {path[1:]}, with one of the "
                f"reasons {', '.join(CAUSES)}; got reason {reason!r}."
            )
        self._renew()
        self.state.failures.append(Failure(len(self.state.entries), reason, tuple(path), where))
        self._write()

    def run(
        self,
        simulator: Simulator | None = None,
        n_iterations: int = 8,
        *,
        stop: Stop | None = None,
        progress: bool = False,
    ) -> Iterator[tuple[Plan, Mission]]:
        """Run missions in a simulator, one per step of the returned iterator.

        Missions run only while you iterate: `for plan, mission in campaign.run(simulator, 8)`.
        The arguments are the same as in `iterate`; `n_iterations` includes earlier missions.

        Yields:
            Each plan and its mission, after the posterior has been updated.

        Raises:
            TrustboError: The input is invalid; raised before any work starts.
        """
        require_whole("n_iterations", n_iterations, 1)
        runner = KinematicSimulator(self.workspace) if simulator is None else simulator
        if isinstance(runner, type) or not callable(getattr(runner, "run", None)):
            raise TrustboError(
                f"simulator needs a method run(path, *, seed, mission) -> Mission; got {runner!r}."
            )
        if stop is not None and (isinstance(stop, type) or not callable(stop)):
            raise TrustboError(f"stop must be a function of the campaign; got {stop!r}.")
        describe = getattr(runner, "describe", lambda: {"simulator": type(runner).__name__})
        self.state.simulation = json.loads(to_json({**describe(), "n_iterations": n_iterations}))
        self._progress = progress
        return self._run(runner, n_iterations, stop)

    def _run(
        self, simulator: Simulator, n_iterations: int, stop: Stop | None
    ) -> Iterator[tuple[Plan, Mission]]:
        """Run missions for `run`, which has checked the arguments."""
        state = self.state
        state.stop_reason = "interrupted"
        options = {"total": n_iterations, "initial": len(state.entries), "desc": "missions"}
        with tqdm(disable=not self._progress, **options) as bar, compiling():
            # Check the rule before each mission: it may already apply when a campaign is resumed.
            while not (reason := self._reason_to_end(n_iterations, stop)):
                n, plan = len(state.entries), self.ask()
                mission = simulator.run(plan.path, seed=state.seed_of("mission"), mission=n)
                self.tell(mission)
                bar.set_postfix_str(in_a_line(state.entries[-1].row), refresh=False)
                bar.update()
                yield plan, mission
        state.stop_reason = reason
        self._write()

    def _reason_to_end(self, n_iterations: int, stop: Stop | None) -> str | None:
        """Return the reason to stop, or None to continue."""
        n = len(self.state.entries)
        if n and stop is not None and (verdict := stop(self)):
            return verdict if isinstance(verdict, str) else _name_of(stop)
        return "n_iterations" if n >= n_iterations else None

    @classmethod
    def load(
        cls, directory: FilePath, *, model: TrustModel | None = None, policy: Policy | None = None
    ) -> Self:
        """Load a campaign from its folder, lock the folder, and continue where it stopped.

        A mission that was written to disk but not yet used for learning is used now.

        Args:
            directory: Folder that was passed as `directory`, or to `Result.save`.
            model: Model of the campaign; required if the model or its priors are custom.
            policy: Policy of the campaign; required if it is a custom function.

        Raises:
            TrustboError: The folder contains no campaign or is locked by another process, a custom
                model or policy is not given, or a file is missing or damaged.
        """
        require_campaign(directory)
        storage = Storage(directory)
        try:
            state, workspace, pending = read_campaign(directory)
            given = state.settings
            if given["policy"] not in POLICIES and policy is None:
                raise TrustboError(
                    f"the policy {given['policy']!r} is not stored; pass the function as policy=."
                )
            campaign = cls(
                workspace, given["start"], given["goal"],
                model=model_from_record(given["model_record"], model),
                policy=given["policy"] if policy is None else policy,
                hazard=Hazard(**given["hazard"]), **{name: given[name] for name in _OPTIONS},
            )  # fmt: skip
            if (name := campaign.state.settings["policy"]) != given["policy"]:
                raise TrustboError(f"policy {name!r} is not the campaign's, {given['policy']!r}.")
            campaign.state, campaign.storage = state, storage
            for entry in pending:
                campaign._add(entry)
        except BaseException:
            storage.release()
            raise
        return campaign

    def __getstate__(self) -> dict[str, Any]:
        return vars(self) | {"storage": None}  # a lock cannot be pickled

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        if self.storage is not None:
            self.storage.release()


def _name_of(function: object) -> str:
    return getattr(function, "__name__", type(function).__name__)
