"""Result of a campaign: posterior, maps, history and recommended path."""

import threading
from collections.abc import Callable, Sequence
from itertools import chain, zip_longest
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import rioxarray  # noqa: F401  (registers the .rio accessor)
import xarray as xr

from trustbo.campaign.cache import computed
from trustbo.campaign.choose import informed_planner
from trustbo.campaign.course import Course
from trustbo.campaign.folder import FolderStorage, without_lost_posteriors
from trustbo.campaign.learning import fitted_missions, learn_hazard
from trustbo.campaign.past_failures import with_past_failures
from trustbo.campaign.settings import to_planner
from trustbo.campaign.state import EARLIER, State
from trustbo.data import NOWHERE, POST_SETS, Cell, Mission, path_text
from trustbo.display import Rows, Summary
from trustbo.errors import (
    TrustboError,
    require_choice,
    require_kind,
    require_positive,
    require_switch,
)
from trustbo.files import FilePath
from trustbo.fixed import marked
from trustbo.hazard.risk import BoundRisk
from trustbo.inference.learner import add_latent
from trustbo.inference.learns import Learner
from trustbo.inference.score import Posteriors
from trustbo.models.backend import VERSIONS
from trustbo.models.draws import Draws, NextMission
from trustbo.parallel import computing
from trustbo.planning import InfeasibleError, Plan, Planner
from trustbo.planning.maps import maps_of
from trustbo.planning.robot_trust import robot_maps, robot_trust
from trustbo.planning.ways import Ways, limits_table, ways_of
from trustbo.simulation import Truth
from trustbo.stacking import padded
from trustbo.workspace import Workspace
from trustbo.workspace.closed import closed_text
from trustbo.workspace.grid import Location
from trustbo.workspace.moves import cells_along, posts_along

if TYPE_CHECKING:
    from trustbo.plots.explorer import Explorer

_N_PRIOR_DRAWS = 250
"""Number of prior draws for intervals; they contain place effects of all cells, which are large."""
_MOST_BASES = 4
"""Number of courses whose planners are kept; those of large maps take much memory."""
_FIRST_COLUMNS = (
    "mission",
    "start",
    "goal",
    "robots",
    "status",
    "state",
    "reason",
    "where",
    "failed_bounds",
    "contact_rate",
    "objective",
    "n_bounds",
    "n_unmeasured",
    "path_changed",
    "replanned",
    "path",
)
"""First columns of the table of missions."""


class Result(Summary):
    """Result of the missions of a campaign; properties are computed on first access.

    Results are returned by `iterate`, `resume` and `load_result`.

    Attributes:
        workspace: Workspace of the campaign.
        state: Missions with their plans and posteriors, failures, and settings.
        learner: The model, as campaigns use it.

    Example:
        >>> result = tb.iterate(workspace, (9, 0), (0, 9), n_iterations=2)
        >>> result.trust("r2", (3, 4)).mean()
        >>> result.plot_maps()[0].figure.savefig("maps.png")
    """

    def __init__(self, workspace: Workspace, state: State, learner: Learner) -> None:
        """Store the state of a campaign."""
        self.workspace = workspace
        self.state = state
        self.learner = learner
        self._bases: dict[Course, Planner] = {}  # planners before any learning
        self._turn = threading.RLock()
        self._progress = True  # whether slow work shows a progress bar
        self._computed: dict[str, Any] = {}

    def __getstate__(self) -> dict[str, Any]:
        return vars(self) | {"_turn": None, "_bases": {}, "_computed": {}}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._turn = threading.RLock()

    def _rows(self) -> Rows:
        state = self.state
        settings = state.settings

        counts = self.table()["state"].value_counts()
        shown = [f"{number} {name}" for name, number in counts.items() if name != EARLIER]
        rows = [
            ("course", self._course_text()),
            ("missions", ", ".join(shown) or "none yet"),
            *self._rows_of_earlier(),
            *self._rows_of_closings(),
            ("model", settings["model"]),
            ("policy", f"{settings['policy']}, objective {settings['objective']}"),
        ]

        if state.last is not None:
            plan = self.plan()
            name_of = self.workspace.name_of
            where = f"{name_of(plan.start)} to {name_of(plan.goal)}"
            best = f"{len(plan.path) - 1} bounds from {where}, value {plan.value:z.3g}"
            rows.append(("recommended", best))
        if state.entries and state.last is not None:
            rows.append(("last mission", in_a_line(state.row(len(state.entries) - 1))))
        return rows

    def _course_text(self) -> str:
        """Describe the course of the campaign, or the courses of its missions."""
        if self._own_ends is not None:
            return " to ".join(map(self.workspace.name_of, self._own_ends))
        n = len({entry.course.ends for entry in self.state.entries})
        return f"{n} courses, one for each mission" if n else "any; give start and goal to ask"

    def _rows_of_earlier(self) -> Rows:
        missions = self.state.earlier.missions
        if not missions:
            return []
        n_here = sum(not mission.map for mission in missions)
        return [("earlier missions", f"{n_here} on this map, {len(missions) - n_here} elsewhere")]

    def _rows_of_closings(self) -> Rows:
        n_next = len(self.state.entries) + 1
        name_of = self.workspace.name_of
        counting = [one for one in self.state.closings if not one.why_over(n_next)]
        texts = [f"{closed_text(one.closed, name_of)} {one.until_text}" for one in counting]
        return [("closed", "; ".join(texts))] if texts else []

    @property
    def settings(self) -> dict[str, Any]:
        """Settings of the campaign, its model and its simulator."""
        state = self.state
        version = {"trustbo_version": VERSIONS["trustbo"]}
        return {**state.simulation, **state.settings, **version}

    @property
    def stop_reason(self) -> str:
        """Why the campaign ended."""
        return self.state.stop_reason

    @property
    def missions(self) -> list[Mission]:
        """All missions in order, with the awareness used for learning."""
        return [entry.mission for entry in self.state.entries]

    @property
    def posteriors(self) -> Posteriors:
        """List of the parameter posteriors after each mission; None where there was none yet."""
        trees = [entry.posterior and entry.posterior() for entry in self.state.entries]
        initial = self.state.initial
        return Posteriors(trees, self.missions, initial and initial())

    @computed
    def posterior(self) -> xr.DataTree:
        """Posterior after the last mission, with all groups, for ArviZ.

        The group `hazard` also contains `p_fail` (move, row, col, next_move), the posterior mean
        failure probability of each bound; NaN where there is no bound.

        Its missions are labelled by their index in `missions`. Those of earlier campaigns come
        first and have negative labels, -1 for the last. To add all groups to an earlier
        posterior, use `inference.add_latent`.

        Raises:
            TrustboError: Nothing could be learned yet.
        """
        stored = self.state.posterior
        if stored is None:
            raise TrustboError(
                f"there is no posterior: none of the {len(self.missions)} recorded missions can be "
                "used for learning yet; table() lists the reasons."
            )

        indices = np.atleast_1d(stored.attrs["missions"]).astype(int).tolist()
        used = fitted_missions(self.state, indices)
        whole = add_latent(stored, used, model=self.learner.model, progress=self._progress)

        for group in whole.children.values():
            if "mission" in group.dims:
                group.dataset = group.to_dataset().assign_coords(mission=indices)
        p_fail = self.hazard["trials"].copy(data=self.risk.mean)
        whole["hazard"] = xr.DataTree(self.hazard.assign(p_fail=p_fail))
        return whole

    @property
    def model(self) -> Any:
        """Trust model or NumPyro function; None if it is custom and was read from files."""
        model: Any = getattr(self.learner, "model", None)
        return getattr(model, "function", model)

    @computed
    def belief(self) -> Draws:
        """Parameter draws of the last posterior, or of the prior before anything was learned."""
        if self.state.last is not None:
            return self._ahead.expected
        if self.state.settings["initial"] == "prior_draw":
            return self.draw_prior(1)
        return self.learner.prior_mean(self.workspace)

    @property
    def forecast(self) -> Draws:
        """Draws like `belief`, for intervals: with effects of robots in the next mission drawn.

        They include the effects of robots in bounds. Before anything was learned, they are draws of
        the prior.
        """
        return self._ahead.drawn

    @computed
    def _ahead(self) -> NextMission:
        """Draws of the last posterior, or of the prior, for the next mission."""
        posterior = self.state.posterior
        if posterior is not None:
            return self.learner.next_mission(posterior, self.workspace)
        seed = State(self.state.settings).seed_of("prior")
        return self.learner.first_mission(_N_PRIOR_DRAWS, seed, self.workspace)

    def draw_prior(self, n_draws: int) -> Draws:
        """Draw parameters from the prior, with a leading axis (draw,)."""
        seed = State(self.state.settings).seed_of("prior")
        return self.learner.prior_draws(n_draws, seed, self.workspace)

    @computed
    def hazard(self) -> xr.Dataset:
        """Group `hazard` of the posterior; see `hazard.fit_hazard`."""
        return learn_hazard(self.state, self.workspace)

    @computed
    def risk(self) -> BoundRisk:
        """Failure probability of each bound, given all missions so far."""
        return BoundRisk(self.hazard, self.workspace)

    @property
    def _own_ends(self) -> tuple[Cell, Cell] | None:
        """Start and goal that were given to the campaign; None if it has no course of its own."""
        settings = self.state.settings
        if settings["start"] is None:
            return None
        return tuple(settings["start"]), tuple(settings["goal"])

    @property
    def _last_ends(self) -> tuple[Cell, Cell] | None:
        """Start and goal of the last plan, or of the last earlier mission on this map."""
        state = self.state
        if state.asked is not None:
            return state.asked.start, state.asked.goal
        if state.entries:
            return state.entries[-1].course.ends

        here = [mission.path for mission in state.earlier.missions if not mission.map]
        return (here[-1][0], here[-1][-1]) if here else None

    def _course(
        self,
        start: Location | None,
        goal: Location | None,
        robots: Sequence[str] | None,
        *,
        usual: tuple[Cell, Cell] | None,
    ) -> Course:
        """Return the course with these ends; those of `usual` replace an end that is missing.

        Raises:
            TrustboError: An end is missing or is not a passable cell, or a robot is unknown.
        """
        found = []
        for k, (name, given) in enumerate({"start": start, "goal": goal}.items()):
            if given is None and usual is None:
                raise TrustboError(
                    f"{name} is missing, and the campaign has no course of its own; give start= "
                    "and goal=, such as start=(9, 0), goal=(0, 9)."
                )
            place: Any = usual[k] if given is None and usual is not None else given
            found.append(self.workspace.locate(place, name))

        team = self.workspace if robots is None else self.workspace.of_robots(robots)
        return Course(found[0], found[1], team.team.names, self._closed)

    @property
    def _closed(self) -> tuple[tuple[tuple[Cell, ...], str], ...]:
        """What is closed for the next mission now, as in `Course`."""
        return tuple((self.workspace.closed | self.state.closed).items())

    def _base_of(self, course: Course) -> Planner:
        """Return the planner of a course before any learning."""
        with self._turn:
            if course not in self._bases:
                while len(self._bases) >= _MOST_BASES:
                    del self._bases[next(iter(self._bases))]
                ground = self.workspace.with_closed(dict(course.closed))
                team = ground.of_robots(course.robots)
                self._bases[course] = to_planner(self.state.settings, team, *course.ends)
            return self._bases[course]

    def planner_of(self, course: Course) -> Planner:
        """Return the planner of a course, which accounts for the failures so far.

        The courses of a campaign are in `courses`. The planner's workspace has the robots that take
        part.
        """
        return self._of_course("planner", course, lambda: self._informed(course))

    def _informed(self, course: Course) -> Planner:
        return informed_planner(self._base_of(course), self.risk)

    def _of_course[T](self, name: str, course: Course, compute: Callable[[], T]) -> T:
        """Return a value of a course, which is computed once until something is recorded."""
        with self._turn:
            of_courses = self._computed.setdefault(name, {})
            if course not in of_courses:
                of_courses[course] = marked(compute())
            return of_courses[course]

    def _shown(
        self,
        start: Location | None = None,
        goal: Location | None = None,
        robots: Sequence[str] | None = None,
    ) -> Course:
        """Return a course to be shown: by default the campaign's own, or else the last one."""
        usual = self._own_ends or self._last_ends
        return self._course(start, goal, robots, usual=usual)

    @property
    def planner(self) -> Planner:
        """Planner of the course of `plan()`, which accounts for the failures so far."""
        return self.planner_of(self._shown())

    def recommend(
        self,
        start: Location | None = None,
        goal: Location | None = None,
        *,
        robots: Sequence[str] | None = None,
    ) -> Plan:
        """Plan the best path under the mean of `belief`, regardless of the policy, without bands.

        If no path satisfies `max_failure`, the safest path is returned. The arguments are those of
        `plan`.
        """
        return self._recommended(self._shown(start, goal, robots))

    def _recommended(self, course: Course) -> Plan:
        return self._best(self.planner_of(course), course)

    def _best(self, planner: Planner, course: Course) -> Plan:
        """Return the best plan of a planner of a course or, beyond `max_failure`, the safest."""
        mean = self._belief_of(course).mean()
        try:
            return planner.plan(mean)
        except InfeasibleError as error:
            return planner.evaluate(error.stations, mean)

    def plan(
        self,
        start: Location | None = None,
        goal: Location | None = None,
        *,
        robots: Sequence[str] | None = None,
    ) -> Plan:
        """Recommend a path, the best under the posterior mean, with posterior credible bands.

        Nothing is recorded. `Campaign.ask` returns the next path to run, which a policy chooses.

        Args:
            start: First cell, or a position in this cell; see `Workspace.locate`. By default, the
                start of the campaign or, if it has no course of its own, of the last mission.
            goal: Last cell, or a position in this cell, with the same default.
            robots: Names of the robots that take part; by default the whole team.

        Raises:
            TrustboError: No course is known, a cell is not passable, or a robot is unknown.
            NoPathError: The goal cannot be reached.

        Example:
            >>> result.plan().path == result.path
            True
            >>> result.plan(start=(0, 0), goal=(9, 9), robots=("r1", "r3")).trust.shape[1]
            2
        """
        course = self._shown(start, goal, robots)
        return self._of_course("plan", course, lambda: self._with_bands(course))

    def _with_bands(self, course: Course) -> Plan:
        planner = self.planner_of(course)
        best = with_past_failures(self._recommended(course), self.state, planner)
        return best.with_draws(planner.evaluate(best.stations, self.forecast))

    @property
    def path(self) -> list[Cell]:
        """Recommended path, that of `plan()`."""
        return list(self.plan().path)

    def _belief_of(self, course: Course) -> Draws:
        """Return the draws of `belief` for the robots that take part."""
        if course.robots == self.workspace.team.names:
            return self.belief
        return self.belief.in_order(course.robots, self.workspace.features)

    @property
    def courses(self) -> list[Course]:
        """Courses of all missions and of the plan that is asked for, each once, in order.

        They have the cells and bounds that are closed now.
        """
        plans = [entry.plan for entry in self.state.entries]
        if self.state.asked is not None:
            plans.append(self.state.asked)
        closed = self._closed
        return list(dict.fromkeys(Course.of(plan)._replace(closed=closed) for plan in plans))

    def trust(
        self,
        robot: str | None = None,
        cell: Location | None = None,
        *,
        move: str | None = None,
        posts: str = POST_SETS[0],
        as_rate: bool = False,
        expected: bool = False,
    ) -> xr.DataArray:
        """Compute how trustworthy a robot will be while the lead enters a cell.

        Expected trust is carried over from bound to bound, so it depends on the path. Instead, this
        method returns stationary trust, to which expected trust converges if a bound with the drift
        u is repeated: u / (1 - beta0), (I - B0)^-1 u for `CoupledTrust`, or u if the model has
        `memory="deviation"`. If no move is given, it is averaged over the bounds that enter the
        cell. Stationary trust is an expected contact rate that is not limited to [0, 1] or, for the
        family `"beta_binomial"`, the logit of a contact rate.

        The draws are those of the last posterior or, before anything was learned, of the prior.
        They contain the effects of places and of robots in the next mission.

        Args:
            robot: Name of a robot of T2; by default all robots.
            cell: Cell (row, col) that the lead enters, or a position in it (see
                `Workspace.locate`); by default all cells.
            move: Direction of the bound that enters the cell, such as `"ne"`; by default the mean
                over all directions.
            posts: Set of posts from which T2 watches; see `Workspace.post_sets`.
            as_rate: Whether to return the expected contact rate instead of trust.
            expected: Whether to use the expected effects of robots in the next mission, instead of
                drawing them.

        Returns:
            Stationary trust of each posterior draw, as a DataArray with the dims (draw, robot, row,
            col). If a robot or cell is given, its dims are left out. Values are NaN where no bound
            enters a cell and, with a warning, for draws in which trust diverges. See
            `planning.Planner.trust`.

        Raises:
            TrustboError: The robot, move or set of posts is unknown, the cell is off the grid or
                impassable, no such bound enters the cell, or trust diverges in all draws.

        Example:
            >>> trust = result.trust("r2", (3, 4))
            >>> float(trust.mean()), float(trust.std())
        """
        require_switch("as_rate", as_rate)
        require_switch("expected", expected)
        draws = self._ahead.of_robots(expected=expected)
        about = {"move": move, "posts": posts, "as_rate": as_rate}
        return robot_trust(self.workspace, draws, robot, cell, **about)

    def compare_posts(self) -> pd.DataFrame:
        """Compare the sets of posts in each bound of the recommended path.

        Returns:
            Table of `Planner.compare_posts`, with the expected effects of robots.

        Example:
            >>> result.compare_posts().query("chosen")
        """
        return self.planner.compare_posts(self.plan().stations, self.belief)

    def ways(
        self,
        start: Location | None = None,
        goal: Location | None = None,
        *,
        robots: Sequence[str] | None = None,
    ) -> Ways:
        """Compare ways of a course: best contact, safest, shortest, and what lies between.

        The price of a failure is that of the campaign's plans. To drive way k, pass
        `ways[k].stations` to `Campaign.suggest`.

        Args:
            start: First cell, as in `plan`.
            goal: Last cell, as in `plan`.
            robots: Names of the robots that take part; by default the whole team.

        Raises:
            TrustboError: The objective is not lost_contact, an end is missing or is not a passable
                cell, or a robot is unknown.
            NoPathError: The goal cannot be reached.

        Example:
            >>> ways = result.ways((9, 0), (0, 9))
            >>> ways.to_frame()[["name", "contact_lost", "p_arrive", "metres"]]
        """
        course = self._shown(start, goal, robots)
        return self._of_course(
            "ways", course, lambda: ways_of(self.planner_of(course), self._belief_of(course))
        )

    def limits(
        self,
        start: Location | None = None,
        goal: Location | None = None,
        *,
        robots: Sequence[str] | None = None,
        degrees: float = 2.0,
    ) -> pd.DataFrame:
        """Return what the slope limit costs: the best plan, if robots withstood more or less.

        The plans have the failure probabilities of robots whose slope limit is by so many degrees
        above or below what the missions and the stated limit say. Routes and passable cells are
        those of the stated limit, so a way through cells that it closes is not found.

        Args:
            start: First cell, as in `plan`.
            goal: Last cell, as in `plan`.
            robots: Names of the robots that take part; by default the whole team.
            degrees: Change of the slope limit.

        Returns:
            A table with a row for minus `degrees`, 0 and plus `degrees`, and the columns `bounds`,
            `metres`, `contact_lost` (None if the objective is another), `p_arrive`, `value` and
            `path`.

        Raises:
            TrustboError: There is no terrain, `degrees` is not positive, an end is missing or is
                not a passable cell, or a robot is unknown.
            NoPathError: The goal cannot be reached.

        Example:
            >>> result.limits((9, 0), (0, 9))[["metres", "contact_lost", "p_arrive"]]
        """
        require_positive("degrees", degrees)
        course = self._shown(start, goal, robots)
        if self.workspace.terrain is None:
            raise TrustboError("limits needs a workspace made with Workspace.from_terrain.")

        def changed(degrees: float) -> Plan:
            margin = self.hazard["margin"] - degrees
            risk = BoundRisk(self.hazard.assign(margin=margin), self.workspace)
            return self._best(informed_planner(self._base_of(course), risk), course)

        def rows() -> pd.DataFrame:
            plans = {-degrees: changed(-degrees), 0.0: self.plan(start, goal, robots=robots)}
            return limits_table(plans | {degrees: changed(degrees)})

        return self._of_course(f"limits {degrees}", course, rows).copy()

    def watchers(
        self,
        start: Location | None = None,
        goal: Location | None = None,
        *,
        robots: Sequence[str] | None = None,
    ) -> pd.DataFrame:
        """Predict which robots see the lead along `plan()`, and for how long at least one or two.

        To see what is lost without a robot, compare the tables of teams with and without it. The
        mean contact of the team, which the value of a plan measures, may rise when a robot with
        little contact stays at home. How strongly robots lose contact at the same time is estimated
        from the contact at each tick that missions recorded; see `planning.contact_dependence`.

        Args:
            start: First cell, as in `plan`.
            goal: Last cell, as in `plan`.
            robots: Names of the robots that take part; by default the whole team.

        Returns:
            Table of `planning.Planner.watchers`, one row for each bound of the path.

        Example:
            >>> whole = result.watchers()
            >>> part = result.watchers(robots=("r1", "r3"))
            >>> float(whole["at_least_two"].mean() - part["at_least_two"].mean())
        """
        course = self._shown(start, goal, robots)
        path = self._of_course("plan", course, lambda: self._with_bands(course)).stations
        measured = [entry.measured for entry in self.state.entries if entry.exclusion is None]
        return self.planner_of(course).watchers(path, self.forecast, missions=measured)

    def robot_maps(self, *, expected: bool = False) -> xr.Dataset:
        """Compute maps of the trust in each robot in the next mission.

        Args:
            expected: Whether to use the expected effects of robots in the next mission, instead of
                drawing them; see `trust`.

        Returns:
            Dataset with the dims (robot, y, x) of the mean `trust_mean` and standard deviation
            `trust_sd` of trust, and the mean `contact_rate`; see `planning.Planner.robot_maps`.
        """
        require_switch("expected", expected)
        return robot_maps(self.workspace, self._ahead.of_robots(expected=expected))

    @property
    def trust_map(self) -> xr.DataArray:
        """Trust map of the team after the last mission, dims (row, col).

        It begins at the start of the course of `plan()`.
        """
        return self._trust_map_of(self._shown()).copy()

    def _trust_map_of(self, course: Course) -> xr.DataArray:
        """Return the trust map of a course, from its start."""

        def compute() -> xr.DataArray:
            return self.planner_of(course).trust_map(self._belief_of(course).mean())

        return self._of_course("trust_map", course, compute)

    @computed
    def history(self) -> xr.Dataset:
        """Dataset of the quantities of each mission, with dim `iteration` (1, 2, ...).

        It contains the planned `path` (row and col of each step, -1 after the goal), the
        `trust_map` used for planning, from the start of the mission, and the numbers and texts of
        `table`. With several sets of posts, it contains the number of the set, `posts`, of each
        bound (-1 after the last). The attribute `objective` is the name of the objective. Missions
        of earlier campaigns on this map come first; they have negative numbers and no trust map.
        Raises TrustboError if there is no mission yet.
        """
        state = self.state
        earlier = state.earlier_here
        if not state.entries and not earlier:
            raise TrustboError("the campaign has no mission yet; call tell or run first.")

        rows = {label: state.earlier_row(i) for label, i in earlier.items()}
        planned = [state.earlier.planned[i] for i in earlier.values()]
        driven = [state.earlier.missions[i].stations for i in earlier.values()]
        stations = [(one or (path,))[0] for one, path in zip(planned, driven, strict=True)]
        like = state.entries[0].trust_map if state.entries else self.workspace.passable
        maps = [xr.full_like(like, np.nan, dtype=float)] * len(rows)

        for j, entry in enumerate(state.entries):
            rows[j + 1] = state.row(j)
            stations.append(entry.plan.stations)
            maps.append(entry.trust_map)

        paths = [cells_along(path).tolist() for path in stations]
        steps = np.stack([*zip_longest(*paths, fillvalue=NOWHERE)], axis=1)
        numbers = pd.Index([*rows], name="iteration")
        table = pd.DataFrame([*rows.values()], numbers)

        dropped = ("where", "failed_bounds", "n_bounds", "path", "posts")
        text = [name for name in dropped if name in table]
        history = table.drop(columns=text).to_xarray()
        history["path"] = ("iteration", "step", "axis"), steps
        if self.workspace.n_posts > 1:
            sets = [posts_along(path) for path in stations]
            history["posts"] = ("iteration", "bound"), padded(sets, -1)
        history["trust_map"] = xr.concat(maps, numbers, combine_attrs="drop")
        history.attrs["objective"] = self.settings["objective"]
        return history.assign_coords(axis=["row", "col"])

    def table(self) -> pd.DataFrame:
        """Return a table with one row per mission, labelled by its number, from 1.

        Missions given up with `Campaign.fail` have no number. Missions of earlier campaigns on this
        map come first and have the negative numbers that they have in `posterior`. The columns are:

        - `start`, `goal`: first and last cell of the plan, such as "9,0", or the name of a place.
        - `robots`: robots that took part.
        - `status`: status of the mission.
        - `state`: "told" (not used yet), "learned", "excluded", "given up" or "earlier".
        - `reason`: reason for the state or the failure; otherwise, the statuses of bounds that were
          not completed.
        - `where`: cells where a bound failed.
        - `failed_bounds`: bounds that were not completed, such as "2 into 1,2 (stuck)".
        - `contact_rate`: mean contact rate.
        - `objective`: value that the plan expected, for example minus the contact lost.
        - `n_bounds`: number of bounds run.
        - `n_unmeasured`: number of bounds run in which no contact rate was measured.
        - `path_changed`: whether the plan differs from the previous one.
        - `replanned`: whether bounds had been driven, or were blocked, when the plan was made.
        - `path`: planned path as text, such as "9,0 8,1".
        - `contact_lost`: contact lost, in bounds: the sum over bounds of 1 minus the mean contact
          rate of the measured robots. Bounds without any rate count as the mean of the mission's
          measured bounds, and bounds that were not run lose all contact.
        - `lost_share`: contact lost, as a share of the bounds of the mission.
        - `posts`: sets of posts of the bounds, if the plan has some that are not standard.
        - `began`: time at which the mission began, UTC, if logs say so.
        - Diagnostics of the posterior; see `fit`.
        """
        state = self.state
        rows = [state.row(j) | {"mission": j + 1} for j in range(len(state.entries))]
        for i, failure in enumerate(state.failures):  # after the mission that precedes it
            rows.insert(failure.after + i, failure.row())

        earlier = state.earlier_here.items()
        rows = [*(state.earlier_row(i) | {"mission": label} for label, i in earlier), *rows]
        columns = dict.fromkeys([*_FIRST_COLUMNS, *chain(*rows)])
        table = pd.DataFrame(rows, columns=list(columns))
        if self.workspace.places:
            names = {path_text([cell]): name for cell, name in self.workspace.place_in.items()}
            table[["start", "goal"]] = table[["start", "goal"]].replace(names)
        return table.astype({"mission": "Int64"}).set_index("mission")

    def closings(self) -> pd.DataFrame:
        """Return a table of the closings, numbered from 1; see `Campaign.close_off`.

        The columns are `where`, `reason`, `until` (a time, the number of a mission, or empty), `at`
        (time of the report), `by`, and `over`, why it no longer counts, or empty if it counts.
        """
        n_next = len(self.state.entries) + 1
        rows = [one.row(n_next, self.workspace.name_of) for one in self.state.closings]
        columns = ["where", "reason", "until", "at", "by", "over"]
        numbers = pd.RangeIndex(1, len(rows) + 1, name="closing")
        return pd.DataFrame(rows, numbers, columns)

    @computing()
    def maps(self, *, n_draws: int = 250, expected: bool = False) -> xr.Dataset:
        """Compute maps of the cells after the last mission; see `planning.Planner.maps`.

        Before anything was learned, the maps are those of the prior without effects.

        Args:
            n_draws: Number of draws.
            expected: Whether to use the expected effects of robots in the next mission, instead of
                drawing them; see `trust`.

        Returns:
            Dataset with the dims (y, x), whose coordinates are the centres of the cells in CRS
            metres; `isel(y=row, x=col)` selects a cell, and the accessor `.rio` writes rasters.
        """
        require_switch("expected", expected)
        if self.state.last is None:
            prior = self.draw_prior(n_draws)
            ahead = NextMission(prior, prior)
        else:
            ahead = self._ahead
        return maps_of(self.planner.problem, ahead, n_draws, 0, expected=expected)

    def plot_maps(self, robot: str | None = None, **options: Any) -> np.ndarray:
        """Plot trust maps and paths of four missions, or the last map of a robot with its sd.

        Cells that no mission entered are hatched, and what is closed is crossed.

        Args:
            robot: Name of a robot. The figure then shows the mean and the standard deviation of the
                trust in this robot, as in `robot_maps`, side by side.
            **options: Options of `plots.trust_maps`.

        Example:
            >>> result.plot_maps("r2")[0].figure.savefig("r2.png")
        """
        from trustbo import plots  # imports matplotlib

        options = {"driven": self._driven, **options}
        if robot is None:
            trust = self.trust_map
        else:
            require_choice("robot", robot, self.workspace.team.names)
            maps = self.robot_maps().sel(robot=robot)
            trust = maps["trust_mean"]
            options = {"missions": [], "sd": maps["trust_sd"], **options}
        plan = self.plan()
        ground = self.workspace.with_closed(plan.workspace.whole.closed)
        return plots.trust_maps(self.history, trust, plan.path, ground, **options)

    @property
    def _driven(self) -> np.ndarray:
        """Whether each cell was entered before each mission and after the last, on this map."""
        before = [mission for mission in self.state.earlier.missions if not mission.map]
        driven = np.zeros((1 + len(self.missions), *self.workspace.grid.shape), dtype=bool)
        own = [[] if entry.exclusion else [entry.mission] for entry in self.state.entries]
        for n, missions in enumerate([before, *own]):
            for mission in missions:
                cells = [bound.cell for bound in mission.bounds if bound.cell != NOWHERE]
                for cell in cells:
                    driven[n:, *cell] = True
        return driven

    def plot_history(self, truth: Truth | None = None, **options: Any) -> np.ndarray:
        """Plot contact, objective and, given the simulator's truth, regret for each mission.

        See `plots.curves.campaign_history` for the options.
        """
        from trustbo.plots.curves import campaign_history

        history = self.history
        if truth is not None:
            require_kind("truth", truth, Truth, "give simulation.Truth.from_simulator(simulator)")

            longest = self.state.settings["max_bounds"]
            paths = [entry.plan.stations for entry in self.state.entries]
            regret = [truth.at(n).regret(path, longest) for n, path in enumerate(paths)]
            unknown = [np.nan] * (history.sizes["iteration"] - len(paths))  # earlier missions
            history = history.assign(regret=("iteration", [*unknown, *regret]))
        return campaign_history(history, **options)

    def explore(self) -> "Explorer":
        """Make an interactive map of the layers and missions for notebooks; see `plots.explore`.

        Raises:
            TrustboError: Nothing could be learned yet.
        """
        from trustbo import plots

        return plots.explore(self.plan(), self.maps(), self.history)

    def save(self, directory: FilePath, *, overwrite: bool = False) -> None:
        """Write the campaign to a folder that `load_result` and `Campaign.load` read.

        An existing campaign in that folder is replaced only with `overwrite`, and only once the new
        one is complete on disk. Other files in the folder are not changed.

        Args:
            directory: Folder to write to.
            overwrite: Whether to replace an existing campaign in that folder.

        Raises:
            TrustboError: The folder already contains a campaign and `overwrite` is False, another
                campaign uses it, other files have the names of a campaign's files, or the folder
                cannot be written.
        """
        require_switch("overwrite", overwrite)
        with self._turn:
            state = without_lost_posteriors(self.state)
            FolderStorage.begin(directory, self.workspace, state, overwrite=overwrite).close()


def in_a_line(row: dict[str, Any]) -> str:
    """Describe a mission in one line, with the diagnostics of the posterior after the mission."""
    names = ("objective", "contact_rate", "k_hat", "kish", "r_hat", "ess_bulk")
    numbers = [f"{name} {row[name]:z.3g}" for name in names if name in row]
    return ", ".join([row["status"], row["state"], *numbers])
