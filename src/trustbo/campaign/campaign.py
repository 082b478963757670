"""Campaign with an ask/tell interface: `ask` for a path, drive it, and `tell` the mission."""

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Self

import numpy as np
import xarray as xr

from trustbo.campaign.earlier import earlier_missions
from trustbo.campaign.folder import FolderStorage
from trustbo.campaign.learning import (
    AWARENESS,
    add_entry,
    as_learned,
    informed_planner,
    instead_of_failure,
    is_excluded_by_user,
    learn,
    learn_hazard,
)
from trustbo.campaign.past_failures import with_past_failures
from trustbo.campaign.read import lock_campaign, read_campaign
from trustbo.campaign.record import RECORD
from trustbo.campaign.replan import follow, whole_plan
from trustbo.campaign.result import Result, in_a_line
from trustbo.campaign.settings import (
    name_of,
    require_options_of_fit,
    require_options_of_planner,
    to_arguments,
    to_settings,
)
from trustbo.campaign.state import EXCLUDED, LEARNED, TOLD, Entry, Failure, Posterior, State
from trustbo.campaign.stopping import Stop
from trustbo.campaign.storage import MemoryStorage, Storage
from trustbo.data import Cell, Mission, path_text
from trustbo.display import bar as progress_bar
from trustbo.display import refreshing, say
from trustbo.errors import (
    TrustboError,
    require_bounds,
    require_choice,
    require_kind,
    require_pair,
    require_whole,
    warn,
)
from trustbo.files import FilePath, holding_interrupts, interpreting, to_json
from trustbo.hazard import Hazard
from trustbo.hazard.risk import BoundRisk
from trustbo.hazard.trials import CAUSES
from trustbo.inference.diagnostics import diagnostics
from trustbo.inference.learner import Model, learner_from_record, learner_of
from trustbo.models.draws import Draws
from trustbo.planning import InfeasibleError, Plan, Planner
from trustbo.planning.policies import POLICIES, Policy, choose_plan, resolve_policy
from trustbo.simulation import KinematicSimulator, RealtimeAwareness
from trustbo.simulation.protocol import Simulator
from trustbo.workspace import Workspace
from trustbo.workspace.grid import Location

_LIKELY_ARRIVAL = 0.9
"""Arrival probability below which a campaign warns if failures have no cost and no limit."""


class Campaign(Result):
    """Campaign that learns from missions and proposes the next path (ask/tell interface).

    `ask` plans a path, and `tell` records the mission on this path and learns from it. With a
    `directory`, each mission is written to disk before the posterior is updated, and
    `Campaign.load` continues after a crash with identical results. An operation that raises an
    error has recorded nothing and can be repeated. If a later step fails, such as writing the
    posterior, the mission is already recorded. A warning then says so, and the next call repeats
    the step.

    All methods can be called from any thread; they run one at a time.

    Attributes:
        policy: Policy that chooses the paths.
        storage: `FolderStorage` of the campaign, or a `MemoryStorage`.

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
        model: Model | None = None,
        policy: str | Policy = "explore",
        objective: str = "lost_contact",
        sampler: str | None = None,
        seed: int = 0,
        directory: FilePath | None = None,
        overwrite: bool = False,
        initial: str = "prior_mean",
        awareness: str = "map",
        hazard: Hazard | None = None,
        planner: Mapping[str, Any] | None = None,
        fit: Mapping[str, Any] | None = None,
        earlier: Result | Sequence[Result] | None = None,
        progress: bool = True,
    ) -> None:
        """Check the arguments and prepare the campaign; no path is planned yet.

        With `earlier`, the campaign first learns from the missions of earlier campaigns.

        Args:
            workspace: Workspace of the paths.
            start: First cell of every path, or a position in this cell; see `Workspace.locate`.
            goal: Last cell of every path, or a position in this cell.
            model: Trust model, or a NumPyro function `model(awareness, contact_rate=None)`; by
                default `models.default_model()`, with place and robot effects.
            policy: Name in `planning.POLICIES`, or a callable `policy(rng, draws, planner)` that
                returns a Plan; see `planning.policies`. By default, the best path under the
                posterior mean is taken until it repeats itself although it may not be the best; see
                `planning.policies.explore`.
            objective: Objective of the paths; see `planning.Planner`.
            sampler: Sampler of the posterior; by default as in `trustbo.fit`.
            seed: Seed of all random numbers.
            directory: Folder that is updated after each mission. It stays locked until `close` is
                called, the `with campaign:` block exits, or the process ends.
            overwrite: Whether to replace an existing campaign in that folder. If an older campaign
                of this process uses the folder, it is closed.
            initial: Parameters for the first plan: `"prior_mean"`, or `"prior_draw"` for one random
                draw from the prior, as in the paper.
            awareness: Awareness from which the model learns. With `"map"`, it is the awareness of
                the workspace. With `"measured"`, as in the paper, it is the measured awareness
                where that is finite, and the awareness of the workspace elsewhere. Plans always use
                the awareness of the workspace.
            hazard: Priors of the probability that a bound fails; by default `Hazard()`.
            planner: Further options of `planning.Planner`, such as `{"max_failure": 0.1}`. Failures
                have no cost until the first one is recorded, unless `failure_cost` is given.
            fit: Further options of `trustbo.fit`, such as `{"draws": 500}`.
            earlier: Results or campaigns whose missions are also data of this campaign, so that
                their posterior is its prior. They may have other courses, terrains and teams.
                Robots are matched by name. What was learned about places is used only if the map is
                the same. A mission that several of them contain is used once.
            progress: Whether to show progress bars for slow fits.

        Raises:
            TrustboError: The start or goal is not a passable cell, a name is unknown, the sampler
                does not support the model, an option cannot be stored in a file, or the folder
                already contains a campaign or cannot be written. The same error is raised if an
                earlier campaign has other features, shares no robot with the team, or has no
                mission to learn from, or if the model cannot be fitted to its missions.
            NoPathError: The goal cannot be reached.
        """
        require_kind("workspace", workspace, Workspace, "give a trustbo.Workspace")
        require_choice("initial", initial, ("prior_mean", "prior_draw"))
        require_choice("awareness", awareness, AWARENESS)
        hazard = Hazard() if hazard is None else hazard
        require_kind("hazard", hazard, Hazard, "give a trustbo.hazard.Hazard")
        options = require_options_of_planner(planner)
        fit_options = require_options_of_fit(fit)
        learner = learner_of(model, workspace, sampler)
        if sampler is None:
            sampler = learner.samplers[0]
        require_choice("sampler", sampler, learner.samplers)

        self.policy = resolve_policy(policy)
        base = Planner(workspace, start, goal, objective, family=learner.family, **options)
        settings = to_settings(
            base,
            learner,
            policy,
            objective=objective,
            sampler=sampler,
            seed=seed,
            initial=initial,
            awareness=awareness,
            hazard=hazard,
            planner=options,
            fit=fit_options,
        )

        state = State(settings, earlier=earlier_missions(earlier, workspace))
        learner.require_poolable(state.earlier.missions, workspace)
        super().__init__(workspace, state, learner, base)

        self._progress = progress
        self._has_warned_of_risk = False
        if state.earlier.missions:
            self._learn_from_earlier()
        self.storage: Storage = MemoryStorage()
        self._turn = self.storage.turn
        if directory is not None:
            self.store_in(directory, overwrite=overwrite)

    def _learn_from_earlier(self) -> None:
        """Fit the posterior given the missions of earlier campaigns."""
        state = self.state
        seed = state.seed_of("fit")
        tree, reason = learn(state, self.learner, self.workspace, seed, self._progress)
        if tree is None:
            raise TrustboError(f"nothing can be learned from the earlier missions: {reason}")

        tree["hazard"] = xr.DataTree(self.hazard)
        state.initial = Posterior("0000", tree)
        self._computed = {"hazard": self.hazard}

    def store_in(self, directory: FilePath, *, overwrite: bool = False) -> None:
        """Write the campaign to a folder, and record everything there from now on.

        A folder that the campaign used before remains as it is, and is released.

        Args:
            directory: Folder, as in the constructor.
            overwrite: Whether to replace an existing campaign in that folder.

        Raises:
            TrustboError: The folder already contains a campaign or cannot be written.
        """
        with self._turn:
            storage = FolderStorage.begin(
                directory, self.workspace, self.state, overwrite=overwrite, take_over=overwrite
            )
            for posterior in self.state.stored:
                posterior.file = storage.stored(posterior)

            before = self.storage
            self._use(storage)
            before.close()

    def _use(self, storage: Storage) -> None:
        """Record everything in a storage from now on."""
        self.storage = storage
        self._turn = storage.turn

    @contextmanager
    def _recorded(self) -> Iterator[None]:
        """Change the state in the block, and write it; if this fails, undo the changes."""
        state = self.state
        before = {
            name: list(value) if isinstance(value, list) else value
            for name, value in vars(state).items()
        }

        rows = [entry.row for entry in state.entries]

        with holding_interrupts():
            try:
                yield
                self.storage.write(state)
            except BaseException:
                vars(state).update(before)
                for entry, row in zip(state.entries, rows, strict=True):
                    entry.row = row
                raise

    def _catch_up(self) -> None:
        """Learn from the missions if an earlier call could not."""
        state = self.state
        if state.due is None:
            return

        n_used = len(state.indices(TOLD, LEARNED))
        tree = None
        reason = ""
        if n_used:
            tree, reason = learn(state, self.learner, self.workspace, state.due, self._progress)
        hazard = self.hazard  # does not depend on what was learned about trust

        with holding_interrupts():
            state.due = None
            if tree is not None:
                tree["hazard"] = xr.DataTree(hazard)
                self._use_posterior(tree, n_used)
            elif n_used:
                for j in state.indices(TOLD):
                    state.entries[j].become(TOLD, reason)
            else:
                state.entries[-1].posterior = state.initial
            self._computed = {"hazard": hazard}

        if reason:
            warn(
                f"all is recorded, but the posterior after mission {len(state.entries)} cannot be "
                f"computed yet: {reason.rstrip('.')}. Learning is retried after the next mission."
            )

    def _use_posterior(self, tree: xr.DataTree, n_used: int) -> None:
        """Store a posterior of `n_used` missions as the one after the last mission."""
        state = self.state
        for j in state.indices(TOLD):
            state.entries[j].become(LEARNED)

        last = state.entries[-1]
        last.row = last.row | diagnostics(tree)
        n_excluded = len(state.entries) - n_used
        suffix = f"-{n_excluded}" if n_excluded else ""
        last.posterior = Posterior(f"{len(state.entries):04d}{suffix}", tree)

    def _finish(self, what: str) -> None:
        """Learn and write after something was recorded; `what` describes it in messages.

        The next call repeats what fails here, so a failure must not look like a failed call.
        """
        try:
            self._catch_up()
            with holding_interrupts():
                self.storage.write(self.state)
        except TrustboError as error:
            warn(
                f"{what}, and what was learned is in memory, but it could not be written: {error} "
                "The next call writes it."
            )
        except BaseException as error:
            error.add_note(f"{what}; it will be learned at the next call.")
            raise

    def ask(self) -> Plan:
        """Plan the next path; further calls return the same plan until `tell`, `fail` or `suggest`.

        The plan is recorded before it is returned.

        Raises:
            TrustboError: The policy did not return a plan, its path is invalid, or the plan cannot
                be recorded.
        """
        with self._turn:
            if self.state.asked is None:
                return self._accept(self._propose())
            return self.state.asked

    def _propose(self) -> Plan:
        """Plan the next path with the policy."""
        self.storage.require_open()
        self._catch_up()
        rng = np.random.default_rng(self.state.seed_of("policy"))
        driven = [entry.mission.path for entry in self.state.entries]
        return self._choose(rng, self.belief, self.planner, driven)

    def _choose(
        self,
        rng: np.random.Generator,
        draws: Draws,
        planner: Planner,
        driven: Sequence[Sequence[Cell]] = (),
    ) -> Plan:
        """Plan a path with the policy, and check what it returned."""
        name = f"policy {self.state.settings['policy']!r}"
        try:
            plan = choose_plan(self.policy, rng, draws, planner, driven)
        except InfeasibleError as error:  # `_record` issues the warning
            return planner.evaluate(error.path, draws.mean())

        require_kind(name, plan, Plan, "a policy must return a trustbo.planning.Plan")
        try:
            planner.require_path(plan.path)
        except TrustboError as error:
            raise TrustboError(f"{name}: {error}") from None

        safest = instead_of_failure(planner, plan, draws)
        if safest.path != plan.path:
            warn(
                f"the path {path_text(plan.path)} almost certainly fails; the safest path is "
                f"planned instead, which arrives with probability {safest.p_arrive:.2g}."
            )
        return safest

    def suggest(self, path: Sequence[Cell]) -> Plan:
        """Set the next path manually; `ask` then returns it.

        Args:
            path: Cells from start to goal.

        Raises:
            TrustboError: The path is invalid, or does not lead from start to goal, or it cannot be
                recorded. `ask` then returns the same plan as before.
        """
        with self._turn:
            self.storage.require_open()

            self._catch_up()
            return self._accept(self.planner.evaluate(path, self.belief.mean()))

    def replan(
        self,
        cell: Location,
        so_far: Mission | None = None,
        *,
        blocked: Sequence[Sequence[Cell]] = (),
    ) -> Plan:
        """Plan the rest of the mission in progress; `ask` then returns the new plan.

        The path of the plan consists of the cells so far and the new rest. To plan the rest, the
        policy uses the trust and the parameters given the contact so far, and the failure
        probabilities given the bounds so far. The rest never contains a bound that failed in this
        mission, in either direction. If a bound failed and the team is in the previous cell, the
        path first leads back there from the cell that was not reached. When the mission is over,
        `tell` it as a whole.

        Args:
            cell: Cell in which the team is, or a position in it (see `Workspace.locate`).
            so_far: Bounds that were run, with the status of each, such as `"stuck"`. By default,
                the team drove the asked path up to `cell`, and no contact was measured.
            blocked: Pairs of neighbouring cells between which no bound can be driven any more. They
                remain blocked in this mission.

        Returns:
            Plan of the whole mission. Trust after each of the bounds so far is that of a
            `TrustFilter`. The value of `lost_contact` includes the contact lost so far. The values
            of other objectives, `p_arrive`, and the limits `max_failure` and
            `max_bounds="shortest+n"` refer to the rest.

        Raises:
            TrustboError: The mission does not start where the plan starts or does not end in
                `cell`, `cell` is the goal, or the plan cannot be recorded. After an error, `ask`
                returns the same plan as before.
            NoPathError: The goal cannot be reached any more.

        Example:
            >>> campaign.replan((2, 1), so_far)  # the team is stuck on its way to (1, 2)
        """
        with self._turn:
            plan = self.ask()
            self._catch_up()
            cell = self.workspace.locate(cell, "cell")
            if so_far is not None:
                require_kind("so_far", so_far, Mission, "give the bounds so far as a Mission")
                so_far = self.workspace.in_order(so_far)

            driven = follow(self, plan, cell, so_far, require_bounds("blocked", blocked))
            n_driven = len(driven.path) - 1
            base = self._base.from_cell(
                cell, x0=driven.filter.state.mean, blocked=driven.blocked, n_driven=n_driven
            )
            risk = self.risk
            if so_far is not None:
                risk = BoundRisk(learn_hazard(self.state, self.workspace, so_far), self.workspace)
            planner = informed_planner(base, risk)

            rng = np.random.default_rng([self.state.seed_of("policy"), n_driven])
            draws = driven.filter.resample()
            rest = self._choose(rng, draws, planner)
            rest = rest.with_draws(planner.evaluate(rest.path, draws))
            whole = whole_plan(self._base.problem, driven, rest)
            return self._record(with_past_failures(whole, self.state, planner, so_far), risk)

    def _with_bands(self, plan: Plan) -> Plan:
        """Add the posterior bands to a plan."""
        return plan.with_draws(self.planner.evaluate(plan.path, self.forecast))

    def _accept(self, plan: Plan) -> Plan:
        """Record a plan, with posterior bands and past failures, as the next one to run."""
        plan = with_past_failures(plan, self.state, self.planner)
        return self._record(self._with_bands(plan), self.risk)

    def _record(self, plan: Plan, risk: BoundRisk) -> Plan:
        """Record a plan as the next one to run, and warn if it is not safe.

        Args:
            plan: Plan to record.
            risk: Failure probabilities that the plan was made with.
        """
        with self._recorded():
            self.state.asked = plan

        if plan.infeasible:
            warn(
                f"the plan arrives with probability {plan.p_arrive:.3g} only, and max_failure does "
                "not allow this. Suggest a safer path, or increase max_failure."
            )
        self._warn_of_risk(plan, risk)
        return plan

    def _warn_of_risk(self, plan: Plan, risk: BoundRisk) -> None:
        """Warn, once per campaign, if failure is likely but does not influence the plans."""
        options = self.state.settings["planner"]
        is_limited = any(options.get(name) is not None for name in ("max_failure", "failure_cost"))
        if self._has_warned_of_risk or is_limited or risk.has_failures:
            return
        if plan.p_arrive is None or plan.p_arrive >= _LIKELY_ARRIVAL:
            return

        self._has_warned_of_risk = True
        remedy = 'planner={"max_failure": ...}'
        if self.planner.problem.objective.of_contact:
            remedy += ' or planner={"failure_cost": ...}'
        warn(
            f"the plan arrives with a probability of only {plan.p_arrive:.2f}, and paths are "
            "chosen without regard to this probability until a mission has failed. To avoid risky "
            f"paths from the start, pass {remedy}. If the max_slope of the robots is uncertain, "
            "lower it. The page Failures of the documentation explains the probability."
        )

    def tell(self, mission: Mission, *, again: bool = False) -> xr.DataTree | None:
        """Record a mission and learn from it.

        For learning, the awareness of the map replaces the measured awareness, unless the campaign
        has `awareness="measured"`. Robots and features may be in any order, and the path may differ
        from the planned path.

        Args:
            mission: Measured mission, whether or not it reached the goal.
            again: Whether to accept a mission with the same data as an earlier one. By default,
                such a mission is refused, because it was probably told twice.

        Returns:
            Posterior of the parameters given all usable missions. If this mission cannot be used
            (yet), a warning is issued, and the previous posterior or None is returned.

        Raises:
            TrustboError: The robots or features differ from the workspace's; the path leaves the
                grid, skips cells, or does not begin at the start of the plan; the status is "ok",
                but the path does not end at the goal; the mission was told before; or it cannot be
                written. The mission is then not recorded.

        Warns:
            UserWarning: The mission is recorded but excluded or not learned yet, or what was
                learned could not be written.
        """
        require_kind("mission", mission, Mission, "give one trustbo.Mission at a time")
        with self._turn:
            self.storage.require_open()
            mission = self.workspace.in_order(mission)
            if not again:
                self._require_new(mission)

            # If no path was asked for since the last mission, one is planned here, which may be
            # slow.
            plan = self.state.asked or self._with_bands(self._propose())
            if mission.path[0] != plan.path[0]:
                raise TrustboError(
                    f"the mission starts in cell {mission.path[0]}; it must start in "
                    f"{plan.path[0]}."
                )
            if mission.status == "ok" and mission.path[-1] != plan.path[-1]:
                raise TrustboError(
                    f'the status "ok" means that the goal {plan.path[-1]} was reached, but the '
                    f"mission ends in cell {mission.path[-1]}; give the planned cells up to the "
                    'goal, and a status such as "aborted".'
                )

            learned = as_learned(mission, self.workspace, self.state.settings["awareness"])
            row = self.state.row_of(plan, mission)
            entry = Entry(plan, mission, learned, self.trust_map, row)

            n_before = len(self.state.entries)
            try:
                with holding_interrupts():
                    self.storage.add_mission(n_before + 1, entry)
                    self._add(entry)
            except BaseException as error:
                if len(self.state.entries) > n_before:  # an interrupt that was held back
                    error.add_note(
                        f"mission {n_before + 1} is recorded; it will be learned at the next call."
                    )
                raise

            self._finish_mission(entry)
            return self.state.posterior

    def _require_new(self, mission: Mission) -> None:
        """Raise TrustboError if a mission with the same data is recorded and not excluded."""
        has_failed = any(status != "ok" for status in mission.statuses)
        if not has_failed and not np.isfinite(mission.contact_rate).any():
            return  # without rates and failures, missions on the same path are alike

        for n, entry in enumerate(self.state.entries, start=1):
            if entry.measured.has_same_data(mission) and not is_excluded_by_user(entry):
                raise TrustboError(
                    f"mission {n} has the same data, so this mission is recorded already. If it is "
                    "another mission, call tell(mission, again=True)."
                )

    def _add(self, entry: Entry) -> None:
        """Add a mission that is on disk, and mark the fit as due."""
        add_entry(self.state, entry)
        self._computed.clear()

    def _finish_mission(self, entry: Entry) -> None:
        """Learn from the last mission, or warn that it is excluded."""
        n = len(self.state.entries)
        if entry.row["state"] == EXCLUDED:
            warn(f"mission {n} is excluded: {entry.row['reason']}")
        self._finish(f"mission {n} is recorded")

    def exclude(self, n: int, reason: str) -> xr.DataTree | None:
        """Exclude a mission from learning; to use it again, pass the mission to `tell`.

        Args:
            n: Number of the mission, from 1.
            reason: Reason to store in the table of missions.

        Returns:
            Posterior of the parameters given the other missions; None if there are none. If it
            cannot be computed, a warning is issued, and the previous posterior is returned.

        Raises:
            TrustboError: There is no such mission, it is already excluded by a user, or the
                exclusion cannot be recorded. The mission is then not excluded.
        """
        with self._turn:
            self.storage.require_open()
            n_told = len(self.state.entries)
            if require_whole("n", n, 1) > n_told:
                raise TrustboError(
                    f"there is no mission {n} to exclude; the last is mission {n_told}."
                )

            entry = self.state.entries[n - 1]
            if is_excluded_by_user(entry):
                raise TrustboError(f"mission {n} is already excluded: {entry.row['reason']}")

            self._catch_up()
            with self._recorded():
                entry.become(EXCLUDED, str(reason))
                self.state.due = self.state.seed_of("exclude")
                self.state.asked = None

            self._computed.clear()
            self._finish(f"the exclusion of mission {n} is recorded")
            return self.state.posterior

    def fail(self, reason: str, *, where: Cell | None = None) -> None:
        """Report that no bound of the planned mission was measured; `ask` then plans again.

        If bounds were run, `tell` a mission with these bounds and its status instead.

        Args:
            reason: Reason to store in the table of missions. Reasons in `hazard.CAUSES`, such as
                "stuck", mean that a bound of the plan failed, and only these are used to learn the
                hazard.
            where: Cell that the team failed to enter, if known.

        Raises:
            TrustboError: The reason is empty, the plan does not enter `where`, `where` is given but
                the reason is not in `hazard.CAUSES`, or the failure cannot be recorded. The failure
                is then not counted.
        """
        if not isinstance(reason, str) or not reason.strip():
            raise TrustboError(f"reason must be a text such as {CAUSES[0]!r}; got {reason!r}.")
        if reason.strip().lower() in CAUSES:  # as in tables
            reason = reason.strip().lower()

        with self._turn:
            self.storage.require_open()
            path = self.ask().path if reason in CAUSES or where is not None else ()
            where = None if where is None else require_pair("where", where)
            if where is not None and (reason not in CAUSES or where not in path[1:]):
                raise TrustboError(
                    f"where = {where} must be a cell that the plan enters, {path[1:]}, with one of "
                    f"the reasons {', '.join(CAUSES)}; got reason {reason!r}."
                )

            self._catch_up()
            with self._recorded():
                failure = Failure(len(self.state.entries), reason, tuple(path), where)
                self.state.failures.append(failure)
                self.state.asked = None

            self._computed.clear()

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
        runner = self._usual_simulator() if simulator is None else simulator
        if isinstance(runner, type) or not callable(getattr(runner, "run", None)):
            raise TrustboError(
                f"simulator needs a method run(path, *, seed, mission) -> Mission; got {runner!r}."
            )
        if stop is not None and (isinstance(stop, type) or not callable(stop)):
            raise TrustboError(f"stop must be a function of the campaign; got {stop!r}.")

        describe = getattr(runner, "describe", lambda: {"simulator": type(runner).__name__})
        with self._turn:
            settings = {**describe(), "n_iterations": n_iterations}
            self.state.simulation = json.loads(to_json(settings))
            self._progress = progress
        return self._run(runner, n_iterations, stop)

    def _usual_simulator(self) -> Simulator:
        """Make the default simulator; robots measure awareness if the campaign learns from it."""
        simulator = KinematicSimulator(self.workspace)
        if self.state.settings["awareness"] == "measured":
            return RealtimeAwareness(simulator)
        return simulator

    def _run(
        self, simulator: Simulator, n_iterations: int, stop: Stop | None
    ) -> Iterator[tuple[Plan, Mission]]:
        """Run missions for `run`, which has checked the arguments."""
        state = self.state
        state.stop_reason = "interrupted"
        options = {"total": n_iterations, "initial": len(state.entries), "desc": "missions"}
        with progress_bar(self._progress, **options) as bar, refreshing(bar):
            # Check the rule before each mission: it may already apply when a campaign is resumed.
            while not (reason := self._reason_to_end(n_iterations, stop)):
                plan = self.ask()
                n = len(state.entries)
                mission = simulator.run(plan.path, seed=state.seed_of("mission"), mission=n)
                self.tell(mission, again=True)  # a simulator without noise may repeat itself
                bar.set_postfix_str(in_a_line(state.entries[-1].row), refresh=False)
                bar.update()
                yield plan, mission

        with self._turn, self._recorded():
            state.stop_reason = reason

    def _reason_to_end(self, n_iterations: int, stop: Stop | None) -> str | None:
        """Return the reason to stop, or None to continue."""
        n = len(self.state.entries)
        if n and stop is not None:
            verdict = stop(self)
            if verdict:
                return verdict if isinstance(verdict, str) else name_of(stop)
        return "n_iterations" if n >= n_iterations else None

    @classmethod
    def load(
        cls,
        directory: FilePath,
        *,
        model: Model | None = None,
        policy: Policy | None = None,
        progress: bool = True,
    ) -> Self:
        """Load a campaign from its folder, lock the folder, and continue where it stopped.

        A mission that was written to disk but not yet used for learning is used now, which takes as
        long as `tell`.

        Args:
            directory: Folder that was passed as `directory`, or to `Result.save`.
            model: Model of the campaign; required if the model or its priors are custom, or if it
                is a NumPyro function.
            policy: Policy of the campaign; required if it is a custom function.
            progress: Whether to report missions that are used now and to show progress bars, in
                this call and in later ones.

        Raises:
            TrustboError: The folder contains no campaign or is locked by another process, a custom
                model or policy is not given, or a file is missing or damaged.
        """
        lock = lock_campaign(directory)
        try:
            state, workspace, pending, files = read_campaign(lock.path)
            given = state.settings
            with interpreting(lock.path / RECORD):
                if given["policy"] not in POLICIES and policy is None:
                    raise TrustboError(
                        f"the policy {given['policy']!r} is not stored; pass the function as "
                        "policy=."
                    )
                campaign = cls(
                    workspace,
                    model=learner_from_record(given["model_record"], model).model,
                    policy=given["policy"] if policy is None else policy,
                    **to_arguments(given),
                )

            name = campaign.state.settings["policy"]
            if name != given["policy"]:
                raise TrustboError(f"policy {name!r} is not the campaign's, {given['policy']!r}.")
            campaign.state = state
            campaign._progress = progress
            campaign._use(FolderStorage(lock, files, workspace))
            if progress and pending:
                n = len(state.entries) + len(pending)
                say(f"fitting mission {n}, which was recorded but not used for learning")
            if state.due is not None:
                campaign._finish("the campaign is recorded")

            for entry in pending:
                campaign._catch_up()
                campaign._add(entry)
                campaign._finish_mission(entry)
        except BaseException:
            lock.release()
            raise
        return campaign

    def close(self) -> None:
        """Release the folder, so that others can use it; a campaign in memory can go on.

        The results can still be used. Further calls have no effect.
        """
        with self._turn:
            self.storage.close()

    def __getstate__(self) -> dict[str, Any]:
        return super().__getstate__() | {"storage": None}  # the copy is in memory

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self._use(MemoryStorage())

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()
