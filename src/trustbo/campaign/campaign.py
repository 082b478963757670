"""Campaign with an ask/tell interface: `ask` for a path, drive it, and `tell` the mission."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, Self

import numpy as np
import xarray as xr

from trustbo.campaign.choose import choose, warn_if_infeasible
from trustbo.campaign.course import Course
from trustbo.campaign.earlier import earlier_closings, earlier_missions
from trustbo.campaign.folder import FolderStorage
from trustbo.campaign.learning import AWARENESS, as_learned, require_new, with_cause
from trustbo.campaign.past_failures import with_past_failures
from trustbo.campaign.read import lock_campaign, read_campaign, warn_of_unrecorded
from trustbo.campaign.recorder import Recorder
from trustbo.campaign.replan import plan_rest
from trustbo.campaign.result import Result
from trustbo.campaign.settings import (
    require_options_of_fit,
    require_options_of_planner,
    to_arguments,
    to_settings,
)
from trustbo.campaign.simulated import require_simulator, run_missions, settings_of
from trustbo.campaign.state import Entry, Failure, State
from trustbo.campaign.stopping import Stop, require_stop
from trustbo.data import Cell, Mission, cells_of, require_path
from trustbo.display import joined, say, with_progress
from trustbo.errors import (
    TrustboError,
    one_line,
    require_bounds,
    require_choice,
    require_kind,
    require_list,
    require_order,
    require_pair,
    require_switch,
    require_whole,
    warn,
)
from trustbo.files import FilePath
from trustbo.hazard import Hazard
from trustbo.hazard.trials import CAUSES
from trustbo.inference.learner import Model, learner_from_record, learner_of
from trustbo.planning import NoPathError, Plan, Planner
from trustbo.planning.policies import Policy, resolve_policy
from trustbo.simulation.protocol import Simulator
from trustbo.workspace import Workspace
from trustbo.workspace.closed import closed_along
from trustbo.workspace.grid import Location
from trustbo.workspace.moves import MOVES


class Campaign(Recorder):
    """Campaign that learns from missions and proposes the next path (ask/tell interface).

    A campaign is about a ground and a team. What it learns in one mission helps on all courses, so
    each mission may have a start and a goal of its own, and robots may stay at home.

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
        >>> with tb.Campaign(workspace, directory="field") as campaign:
        ...     plan = campaign.ask(start=(9, 0), goal=(0, 9))
        ...     campaign.tell(drive(plan.path))  # your robots
    """

    def __init__(
        self,
        workspace: Workspace,
        start: Location | None = None,
        goal: Location | None = None,
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
            start: First cell of the paths for which `ask` is given no other, or a position in this
                cell; see `Workspace.locate`. By default, each call of `ask` needs a start and goal.
            goal: Last cell of these paths, or a position in this cell.
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
            planner: Further options of `planning.Planner`, such as `{"max_failure": 0.1}`. A
                failure costs as many bounds as a shortest path has, if the objective measures
                contact; with `{"failure_cost": 0.0}`, it costs nothing.
            fit: Further options of `trustbo.fit`, such as `{"draws": 500}`.
            earlier: Results or campaigns whose missions are also data of this campaign, so that
                their posterior is its prior. They may have other courses, terrains and teams.
                Robots are matched by name. What was learned about places is used only if the map is
                the same, and so are closings that still count. A mission that several of them
                contain is used once.
            progress: Whether to show progress bars for slow fits.

        Raises:
            TrustboError: Only one of start and goal is given or is not a passable cell, a name is
                unknown, the sampler
                does not support the model, an option cannot be stored in a file, or the folder
                already contains a campaign or cannot be written. The same error is raised if an
                earlier campaign has other features, shares no robot with the team, or has no
                mission to learn from, or if the model cannot be fitted to its missions.
            NoPathError: The goal cannot be reached.
        """
        require_switch("overwrite", overwrite)
        require_switch("progress", progress)
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
        has_course = start is not None
        if has_course != (goal is not None):
            missing = "goal" if has_course else "start"
            raise TrustboError(f"{missing} is missing; give both start and goal, or neither.")
        ends: tuple[Any, Any] = (start, goal) if has_course else _any_ends(workspace)
        base = Planner(workspace, *ends, objective, **options)
        settings = to_settings(
            base,
            learner,
            policy,
            hazard,
            has_course=has_course,
            objective=objective,
            sampler=sampler,
            seed=require_whole("seed", seed, 0),
            initial=initial,
            awareness=awareness,
            planner=options,
            fit=fit_options,
        )

        missions = earlier_missions(earlier, workspace)
        closings = earlier_closings(earlier, workspace)
        state = State(settings, closings=closings, earlier=missions)
        learner.require_poolable(state.earlier.missions, workspace.team.names)
        super().__init__(workspace, state, learner)

        self._progress = progress
        if state.earlier.missions:
            self._use_posterior()
            if self.state.why_not:
                raise TrustboError(
                    f"nothing can be learned from the earlier missions: {self.state.why_not}"
                )
        if directory is not None:
            self.store_in(directory, overwrite=overwrite)

    def ask(
        self,
        start: Location | None = None,
        goal: Location | None = None,
        *,
        robots: Sequence[str] | None = None,
    ) -> Plan:
        """Plan the next path; further calls return the same plan until `tell`, `fail` or `suggest`.

        A call with another course or other robots replaces the plan, and so does a call after the
        plan was closed off, or after something was reopened that it had to avoid. The plan is
        recorded before it is returned.

        Args:
            start: First cell, or a position in this cell; see `Workspace.locate`. By default, that
                of the campaign.
            goal: Last cell, or a position in this cell; by default, that of the campaign.
            robots: Names of the robots that take part; by default the whole team. The objective is
                averaged over these robots, which have the same posts as in the whole team, and
                `tell` then expects their contact rates alone.

        Raises:
            TrustboError: A start or goal is missing or not passable, a robot is unknown, the model
                needs the whole team, the policy did not return a plan, its path is invalid, or the
                plan cannot be recorded. The plan asked for before then remains.
            NoPathError: The goal cannot be reached.

        Example:
            >>> plan = campaign.ask(start=(9, 0), goal=(0, 9), robots=("r1", "r3"))
            >>> plan.robots
            ('r1', 'r3')
        """
        with self._turn, with_progress(self._progress):
            asked = self.state.asked
            if asked is not None and start is None and goal is None and robots is None:
                course = Course.of(asked)._replace(closed=self._closed)
            else:
                course = self._course(start, goal, robots, usual=self._own_ends)
            if asked is not None and _holds(asked, course):
                return asked

            plan = self._propose(course)
            self._accept(plan)
            return plan

    def _propose(self, course: Course) -> Plan:
        """Plan the next path of a course with the policy."""
        self.storage.require_open()
        self._learn()
        rng = np.random.default_rng(self.state.seed_of("policy"))
        entries = self.state.entries
        driven = [entry.mission.path for entry in entries if entry.course.ends == course.ends]
        name = self.state.settings["policy"]
        belief = self._belief_of(course)
        plan = choose(self.policy, name, rng, belief, self.planner_of(course), driven)
        return self._completed(plan)

    def _completed(self, plan: Plan) -> Plan:
        """Add posterior bands and past failures to a plan."""
        planner = self.planner_of(Course.of(plan))
        plan = with_past_failures(plan, self.state, planner)
        return plan.with_draws(planner.evaluate(plan.stations, self.forecast))

    def _evaluated(self, path: Sequence[Cell], course: Course) -> Plan:
        """Plan a given path of a course."""
        belief = self._belief_of(course)
        return self._completed(self.planner_of(course).evaluate(path, belief.mean()))

    def suggest(self, path: Sequence[Cell], *, robots: Sequence[str] | None = None) -> Plan:
        """Set the next path manually; `ask` then returns it.

        Args:
            path: Cells from any start to any goal.
            robots: Names of the robots that take part; by default the whole team.

        Raises:
            TrustboError: The path is invalid, a robot is unknown, or the plan cannot be recorded.
                `ask` then returns the same plan as before.
        """
        with self._turn, with_progress(self._progress):
            self.storage.require_open()
            cells = require_path("path", path)
            if len(cells) < 2:
                raise TrustboError(f"path must have two cells or more; got {len(cells)}.")

            self._learn()
            course = self._course(cells[0][:2], cells[-1][:2], robots, usual=None)
            plan = self._evaluated(cells, course)
            self._accept(plan)
            return plan

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
        with self._turn, with_progress(self._progress):
            asked = self.state.asked
            plan = self.ask() if asked is None else asked
            self._learn()
            cell = self.workspace.locate(cell, "cell")
            if so_far is not None:
                require_kind("so_far", so_far, Mission, "give the bounds so far as a Mission")
                so_far = self._in_order(so_far, plan.robots)
            closed = require_bounds("blocked", blocked)

            base = self._base_of(Course.of(plan)._replace(closed=self._closed))
            plan = plan_rest(self, base, self.policy, plan, cell, so_far, closed)
            self._accept(plan)
            return plan

    def _accept(self, plan: Plan) -> None:
        """Record a plan as the next one to run."""
        self._record(asked=plan)
        warn_if_infeasible(plan)

    def tell(self, mission: Mission, *, again: bool = False, cause: str = "") -> xr.DataTree | None:
        """Record a mission and learn from it.

        For learning, the awareness of the map replaces the measured awareness, unless the campaign
        has `awareness="measured"`. Robots and features may be in any order, and the path may differ
        from the planned path. A mission that began or ended elsewhere than planned is a mission on
        the course of its own path, with a warning.

        Args:
            mission: Measured mission, whether or not it reached the goal.
            again: Whether to accept a mission with the same data as an earlier one. By default,
                such a mission is refused, because it was probably told twice.
            cause: Cause of a failure that says nothing about other bounds and the slope limit, such
                as "mud". Bounds that failed are then recorded as "aborted", from which no failure
                probability is learned. To keep the team away, `close_off` the cell.

        Returns:
            Posterior of the parameters given all usable missions. If this mission cannot be used
            (yet), a warning is issued, and the previous posterior or None is returned.

        Raises:
            TrustboError: The robots differ from those of the plan, or the features from the
                workspace's; the path leaves the grid or skips cells; no path leads from its start
                to its end; the mission was told before; a cause is given, but no bound failed; or
                it cannot be written. The mission is then not recorded.

        Warns:
            UserWarning: The mission began or ended elsewhere than planned; it is recorded but
                excluded or not learned yet; or what was learned could not be written.
        """
        require_switch("again", again)
        require_kind("mission", mission, Mission, "give one trustbo.Mission at a time")
        with self._turn, with_progress(self._progress):
            self.storage.require_open()
            asked = self.state.asked
            mission = self._in_order(mission, None if asked is None else asked.robots)
            mission, cause = with_cause(mission, cause)
            if not again:
                require_new(self.state, mission)

            return self._add(mission, asked, cause=cause)

    def correct(
        self, n: int, mission: Mission, reason: str, *, cause: str = ""
    ) -> xr.DataTree | None:
        """Replace a mission whose log was wrong, and learn from the corrected one.

        The wrong mission is excluded, with the reason, and the corrected one is recorded under the
        next number, with the plan of the wrong one. Both are recorded in one step.

        Args:
            n: Number of the wrong mission, from 1.
            mission: Corrected mission, as for `tell`.
            reason: Reason to store in the table of missions.
            cause: Cause of a failure, as for `tell`.

        Returns:
            Posterior, as for `tell`.

        Raises:
            TrustboError: There is no such mission, it is already excluded by a user, the reason is
                empty, or the corrected mission is refused as by `tell`. Nothing is then recorded.

        Example:
            >>> campaign.correct(1, drive(path), "log of another detector")
        """
        require_kind("mission", mission, Mission, "give one trustbo.Mission at a time")
        with self._turn, with_progress(self._progress):
            self._require_mission(n, reason)
            entries = self.state.entries
            plan = entries[n - 1].plan
            mission, cause = with_cause(self._in_order(mission, plan.robots), cause)
            require_new(self.state, mission)
            reason = f"corrected, see mission {len(entries) + 1}: {reason}"
            return self._add(mission, plan, (n, reason), cause)

    def _add(
        self,
        mission: Mission,
        asked: Plan | None,
        wrong: tuple[int, str] | None = None,
        cause: str = "",
    ) -> xr.DataTree | None:
        """Record a mission and learn from it.

        Args:
            mission: Mission with its robots and features in the order of the workspace.
            asked: Plan of the mission; None if no path was asked for.
            wrong: Number of the mission that it corrects, which is excluded in the same step, and
                the reason; None if it corrects none.
            cause: Cause of a failure from which nothing is learned; see `with_cause`.
        """
        learned = as_learned(mission, self.workspace, self.state.settings["awareness"])
        if mission.robots != self.workspace.team.names:
            team = self.workspace.team.names
            self.learner.require_poolable([mission.with_robots(team)], team)
        plan = self._plan_told(mission, asked)
        trust_map = self._trust_map_of(Course.of(plan))

        before = self.state
        entries = before.entries if wrong is None else self._excluding(*wrong)
        entry = Entry(plan, mission, learned, trust_map, cause, posterior=before.last)
        recorded = f"mission {len(entries) + 1} is recorded"
        try:
            self._record(entries=(*entries, entry), asked=None)
        except BaseException as error:
            if self.state is not before:  # an interrupt that was held back
                error.add_note(f"{recorded}; it will be learned at the next call.")
            raise

        if entry.why_excluded is not None:
            warn(f"mission {len(self.state.entries)} is excluded: {entry.why_excluded}")
        self._learn_and_write(recorded)
        return self.state.posterior

    def _in_order(self, mission: Mission, robots: Sequence[str] | None) -> Mission:
        """Return a mission with its robots and features in the order of the workspace.

        Robots of the team that stayed at home are left out; they have no rates.

        Args:
            mission: Mission of the whole team, or of the robots that take part.
            robots: Robots that take part in the plan; None for the whole team.

        Raises:
            TrustboError: The robots or features differ, or a robot that stayed at home has rates.
        """
        team = self.workspace.team.names
        if robots is not None and set(robots) < set(mission.robots) <= set(team):
            stayed = [name for name in team if name in set(mission.robots) - set(robots)]
            if np.isfinite(mission.of_robots(stayed).contact_rate).any():
                raise TrustboError(
                    f"the mission has rates of {joined(stayed)}, but {joined(robots)} were "
                    f"planned; tell mission.of_robots({tuple(robots)}), or first call ask with "
                    "the robots that went."
                )
            mission = mission.of_robots(robots)

        went = set(mission.robots)
        if robots is not None and went == set(robots):
            return self.workspace.of_robots(robots).in_order(mission)

        absent = [name for name in team if name not in went]
        if absent and went < set(team):
            planned = "" if robots is None else f", but {joined(robots)} were planned"
            raise TrustboError(
                f"the mission has no rates of {joined(absent)}{planned}; give rates that are NaN, "
                f"or first call ask with robots={tuple(mission.robots)}."
            )
        return self.workspace.in_order(mission)

    def _plan_told(self, mission: Mission, asked: Plan | None) -> Plan:
        """Return the plan of a mission that is told.

        It is the plan that was asked for, if the mission has its start and its goal. If no path was
        asked for, it is planned here, which may be slow. A mission on another course has the plan
        of its own path.
        """
        start, last = (mission.path[k] for k in (0, -1))
        ends = self._own_ends if asked is None else (asked.start, asked.goal)
        if ends is not None and start == ends[0] and (mission.status != "ok" or last == ends[1]):
            if asked is not None:
                return asked
            course = self._course(*ends, mission.robots, usual=None)
            try:
                return self._propose(course)
            except NoPathError:  # unless the way was closed since
                return self._propose(course._replace(closed=tuple(self.workspace.closed.items())))

        # What is closed now may have been open then, and was driven anyway.
        course = self._course(start, last, mission.robots, usual=None)
        course = course._replace(closed=tuple(self.workspace.closed.items()))
        self.storage.require_open()
        self._learn()
        try:
            plan = self._evaluated(mission.stations, course)
        except NoPathError:
            raise
        except TrustboError:  # the map says that a bound of the path cannot be driven
            plan = self._propose(course)
        if ends is not None:
            warn(
                f"the mission leads from {start} to {last}, not from {ends[0]} to {ends[1]} as "
                "planned; it is recorded as a mission on the course that it drove."
            )
        return plan

    def fail(self, reason: str, *, where: Cell | None = None) -> None:
        """Report that no bound of the planned mission was measured; `ask` then plans again.

        If bounds were run, `tell` a mission with these bounds and its status instead. `withdraw`
        takes a report back.

        Args:
            reason: Reason to store in the table of missions. Reasons in `hazard.CAUSES`, such as
                "stuck", mean that a bound of the plan failed, and only these are used to learn the
                hazard. Other reasons, such as "mud", say nothing about the slope; to keep the team
                away, `close_off` the cell.
            where: Cell that the team failed to enter, if known.

        Raises:
            TrustboError: The reason is empty or contains a cause without being one, such as "got
                stuck"; a bound failed although no path is planned; the plan does not enter `where`;
                or the failure cannot be recorded. The failure is then not counted.
        """
        if not isinstance(reason, str) or not reason.strip():
            raise TrustboError(f"reason must be a text such as {CAUSES[0]!r}; got {reason!r}.")
        cause = "_".join(reason.lower().replace("_", " ").split())
        if cause in CAUSES:  # "Lost contact" is also read
            reason = cause
        elif named := [known for known in CAUSES if known in cause]:
            raise TrustboError(
                f"the reason {reason!r} names a cause, but is not one, and nothing was recorded. "
                f"Write {named[0]!r} if a bound failed, or else a reason without this word."
            )

        with self._turn:
            self.storage.require_open()
            asked = self.state.asked
            at_a_bound = reason in CAUSES or where is not None
            if at_a_bound and asked is None:
                raise TrustboError(
                    f"no path is planned on which a bound can have failed ({reason}). Call ask "
                    "before the mission is run; a mission that was told with this status already "
                    "counts as a failure."
                )
            path = asked.stations if at_a_bound and asked is not None else ()
            where = None if where is None else require_pair("where", where)
            entered = tuple(cells_of(path[1:]))
            if where is not None and where not in entered:
                raise TrustboError(
                    f"where = {where} must be a cell that the plan enters; these are {entered}."
                )

            self._learn()
            failure = Failure(len(self.state.entries), reason, tuple(path), where)
            self._record(failures=(*self.state.failures, failure), asked=None)

    def run(
        self,
        simulator: Simulator | None = None,
        n_iterations: int = 8,
        *,
        courses: Sequence[Sequence[Location]] | None = None,
        stop: Stop | None = None,
        progress: bool = False,
    ) -> Iterator[tuple[Plan, Mission]]:
        """Run missions in a simulator, one per step of the returned iterator.

        Missions run only while you iterate: `for plan, mission in campaign.run(simulator, 8)`.
        The arguments are the same as in `iterate`; `n_iterations` includes earlier missions.
        Without `courses`, all missions have the course of the campaign.

        Yields:
            Each plan and its mission, after the posterior has been updated.

        Raises:
            TrustboError: The input is invalid; raised before any work starts.
        """
        require_switch("progress", progress)
        require_whole("n_iterations", n_iterations, 1)
        runner = require_simulator(self, simulator)
        require_stop(stop)
        ends = self._require_courses(courses)

        with self._turn:
            self.state = replace(self.state, simulation=settings_of(runner, n_iterations, ends))
            self._progress = progress
        return self._run(runner, n_iterations, ends, stop)

    def _require_courses(
        self, courses: Sequence[Sequence[Location]] | None
    ) -> list[tuple[Cell, Cell]]:
        """Return start and goal of each course; none if missions take the campaign's own.

        Raises TrustboError or NoPathError for a course on which no path can be planned.
        """
        if courses is None:
            if self._own_ends is None:
                raise TrustboError(
                    "the campaign has no course of its own; give courses=[(start, goal), ...]."
                )
            return []

        remedy = "give a list of pairs (start, goal)"
        found = []
        for given in require_list("courses", require_order("courses", courses), remedy=remedy):
            ends: list[Any] = require_list("a course", require_order("a course", given))
            if len(ends) != 2:
                raise TrustboError(f"a course is a start and a goal; got {one_line(given)}.")
            course = self._course(ends[0], ends[1], None, usual=None)
            self._base_of(course)
            found.append(course.ends)
        if not found:
            raise TrustboError(f"courses must have one entry or more; {remedy}.")
        return found

    def _run(
        self,
        simulator: Simulator,
        n_iterations: int,
        courses: Sequence[tuple[Cell, Cell]],
        stop: Stop | None,
    ) -> Iterator[tuple[Plan, Mission]]:
        """Run missions for `run`, which has checked the arguments."""
        self.state = replace(self.state, stop_reason="interrupted")
        reason = yield from run_missions(
            self, self.ask, self.tell, simulator, n_iterations, courses, stop, self._progress
        )
        with self._turn:
            self._record(stop_reason=reason)

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
            model: Model of the campaign; required if it is a NumPyro function, or if a prior has a
                class of your own.
            policy: Policy of the campaign; required if it is a custom function.
            progress: Whether to report missions that are used now and to show progress bars, in
                this call and in later ones.

        Raises:
            TrustboError: The folder contains no campaign or is locked by another process, a custom
                model or policy is not given, or a file is missing or damaged.
        """
        require_switch("progress", progress)
        lock = lock_campaign(directory)
        try:
            state, workspace, files = read_campaign(lock.path)
            warn_of_unrecorded(lock.path, len(state.entries))
            learner = learner_from_record(state.settings["model_record"], model)
            arguments = to_arguments(state.settings, policy)
            campaign = cls(workspace, model=learner.model, **arguments)
            campaign.state = state
            campaign._progress = progress
            campaign.storage = FolderStorage(lock, files, workspace)
            campaign._turn = campaign.storage.turn
            if state.fitted != state.used:
                if progress:
                    n = len(state.entries)
                    say(f"fitting mission {n}, which was recorded but not used for learning")
                campaign._learn_and_write("the campaign is recorded")
        except BaseException:
            lock.release()
            raise
        return campaign


def _holds(asked: Plan, course: Course) -> bool:
    """Return whether a plan that was asked for is still a plan of a course.

    A mission that was replanned is on its way; `replan` plans around what was closed since.
    """
    before = Course.of(asked)
    if before._replace(closed=course.closed) != course:
        return False
    if asked.is_replanned:
        return True
    closed = dict(course.closed)
    reopened = dict(before.closed).keys() - closed.keys()
    return not reopened and not closed_along(closed, asked.path)


def _any_ends(workspace: Workspace) -> tuple[Cell, Cell]:
    """Return the ends of a bound, for a planner that checks the options of a campaign."""
    bounds = np.argwhere(workspace.open_bounds)
    if not len(bounds):
        raise TrustboError("the robots can drive no bound of this workspace; choose another team.")

    move, row, col = bounds[0].tolist()
    down, right = MOVES[move]
    return (row - down, col - right), (row, col)
