"""Workspace with the awareness of every bound and the passability of every cell."""

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import Any, Self

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from trustbo.arrays import as_names
from trustbo.data import (
    FEATURES,
    LINE_OF_SIGHT,
    POST_SETS,
    THREAT,
    Cell,
    Mission,
    Station,
    default_features,
    is_predicted,
    path_text,
    require_map,
)
from trustbo.display import Rows, Summary, announced
from trustbo.errors import (
    TrustboError,
    composed,
    require_choice,
    require_kind,
    require_list,
    require_positive,
    require_switch,
    require_whole,
)
from trustbo.fixed import Fixed, fix
from trustbo.team import Team
from trustbo.terrain.composite import CompositeIndex
from trustbo.terrain.features import PAPER_VISIBILITY, TRAVERSABILITY, VISIBILITY
from trustbo.terrain.read import require_terrain
from trustbo.workspace.awareness import (
    cell_maps,
    labelled,
    labelled_onward,
    of_arrays,
    of_moves,
    options_of,
    pixel_maps,
    unlabelled,
    with_line_of_sight,
)
from trustbo.workspace.closed import closed_mask, closed_text, require_closed
from trustbo.workspace.difficulty import Difficulty
from trustbo.workspace.grid import MAX_MISSING, Grid, Location
from trustbo.workspace.line_of_sight import onward_maps
from trustbo.workspace.moves import MOVE_NAMES, MOVES, existing_bounds, for_sets, pairs_along
from trustbo.workspace.posts import TRAVERSABLE, Posts
from trustbo.workspace.sight import Sight
from trustbo.workspace.surface import Surface, surface_of
from trustbo.workspace.threats import exposure_of

_NO_NAME = ",=\n"
"""Signs that cannot be part of the name of a place, because cells and positions have them."""
_MIDDLE = (0.1, 0.9)
"""Quantiles at the ends of the middle 80 % of bounds."""


@dataclass(frozen=True, eq=False, repr=False)
class Workspace(Fixed, Summary):
    """Planning grid with the situational awareness of each robot in each bound.

    Attributes:
        awareness: DataArray (robot, move, row, col, feature), in [0, 1]. A value applies to the
            bound that enters the cell (row, col) by the move; NaN if there is no such bound. With
            several sets of posts, the moves are named "ne" with the standard set, "ne far", ...
        passable: Boolean DataArray (row, col).
        grid: Shape, position and cell size of the planning grid.
        team: Lead and overwatching robots.
        terrain: Dataset of the DEM and the DSM; None if the workspace was made from arrays.
        pixels: Dataset (y, x) of each feature, float32, and of `passable`; None without a terrain.
        composites: Fitted composite indices, keyed by feature.
        posts: The robots' stops, posts and routes on the terrain; None without a terrain.
        onward: DataArray (robot, move, row, col, next_move), the change of line of sight by the
            next move and by the set of posts that is used there; NaN where there is no such move.
            None with one set of posts, which predicts the mean over the next moves.
        within: Workspace of the whole team if this one is that of some of its robots (see
            `of_robots`); None if it is that of the whole team.
        places: Positions x and y of named places, in CRS metres, by name; see `with_places`.
        closed: Reason for each closed cell, (cell,), and each closed bound, (cell, cell); see
            `closing`.

    Example:
        >>> terrain = tb.terrain.example()
        >>> workspace = tb.Workspace.from_terrain(terrain, shape=(4, 4))
        >>> workspace.awareness.sel(feature="line_of_sight").mean("robot").max("move")
    """

    awareness: xr.DataArray
    passable: xr.DataArray
    grid: Grid
    team: Team
    terrain: xr.Dataset | None = None
    pixels: xr.Dataset | None = None
    composites: dict[str, CompositeIndex] = field(default_factory=dict)
    posts: Posts | None = None
    onward: xr.DataArray | None = None
    within: "Workspace | None" = None
    places: dict[str, tuple[float, float]] = field(default_factory=dict)
    closed: dict[tuple[Cell, ...], str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._fix()

    @classmethod
    def from_terrain(
        cls,
        terrain: xr.Dataset,
        shape: tuple[int, int] = (10, 10),
        team: Team | None = None,
        *,
        features: Mapping[str, object] | None = None,
        bounds: bool = True,
        sight: Sight | None = None,
        n_posts: int | None = None,
    ) -> Self:
        """Make a workspace with features computed from a DEM and a DSM.

        The mean of a feature over a cell applies to all robots and to all bounds into the cell. A
        cell is impassable if more than half of its pixels are missing or steeper than the slope
        limit. With `bounds`, a cell is also impassable if it has too few passable pixels for the
        team, not counting pixels that are cut off from the rest; a warning is then issued. Openness
        is measured up to the lidar's range, but no farther than the diagonal of a cell, because T2
        does not watch the lead beyond one bound.

        Because overwatch involves two cells, traversability is averaged along the robots' tracks in
        a bound. In addition, the feature `line_of_sight` is the predicted fraction of time in which
        a robot and the lead can see each other, given the assumed model of sight.

        Args:
            terrain: Dataset from `read_terrain` or `synthetic_terrain`, with the heights `dem` and
                `dsm`, shape (y, x), in metres, NaN where missing. The coordinates `x` and `y` are
                those of a projected CRS, in metres.
            shape: Number of rows and columns of the planning grid, which covers the terrain.
            team: Lead and overwatching robots; by default a lead and three robots.
            features: Mapping of each awareness feature to pixel features (see `terrain.FEATURES`).
                A list of pixel features forms a composite index; a single name is used unchanged
                and must be in [0, 1]. The default is traversability and visibility.
            bounds: If False, define awareness for cells only, as in the paper, without line of
                sight and with the visibility of `terrain.PAPER_VISIBILITY`.
            sight: Assumed model of sight; by default `Sight()`.
            n_posts: Number of sets of posts, 1 to 3, from which T2 can watch the lead in each
                bound; by default 3, and 1 without `bounds`. With more than one, planners choose a
                set in each cell of a path together with the cells. The sets are, in this order:
                "standard"; "far", up to 60 m from the lead's stop and 20 m apart; and "route",
                mostly for the sight of the lead's route. Line of sight, traversability and the
                difficulty of driving differ between sets. Give 1 if contact does not depend on
                sight, as over a radio link, or if robots cannot be told where to stand.

        Returns:
            Workspace whose `awareness` has the dims (robot, move, row, col, feature), with values
            in [0, 1]. There are eight moves, or eight for each set of posts. Row 0 is in the north.
            A value applies to the bound that enters (row, col) by the move, and is NaN if there is
            no such bound. The features are those of `features` and, with `bounds`, `line_of_sight`.

        Raises:
            TrustboError: The dataset is not a terrain, the grid is too fine for the raster, all
                cells are too small for the team, no cell is passable, or a feature has a reserved
                name or a name that files cannot store.

        Example:
            >>> tb.Workspace.from_terrain(terrain, shape=(10, 10), team=tb.Team(n_robots=3))
        """
        require_switch("bounds", bounds)
        terrain = require_terrain(terrain)
        team = Team.of(team)
        sight = Sight.of(sight)
        grid = Grid.over(terrain, shape)
        if n_posts is None:
            n_posts = len(POST_SETS) if bounds else 1
        n_posts = require_whole("n_posts", n_posts, 1, len(POST_SETS))
        if n_posts > 1 and not bounds:
            raise TrustboError(
                "n_posts > 1 needs line of sight, which is defined for bounds; leave out "
                "bounds=False, or n_posts."
            )

        if features is None:
            visibility = VISIBILITY if bounds else PAPER_VISIBILITY
            features = {"traversability": TRAVERSABILITY, "visibility": visibility}

        with announced("Computing posts, routes and line of sight (minutes on large grids)."):
            # Pixels.
            surface = surface_of(terrain, team.max_slope)
            options = options_of(surface, grid, team, sight)
            pixels, composites = pixel_maps(terrain, features, options)
            drivable = xr.DataArray(surface.passable, terrain["dem"].coords, ("y", "x"))

            # Cells.
            cells, passable = cell_maps(pixels, drivable, grid)
            traversability = pixels[TRAVERSABLE].values if TRAVERSABLE in pixels else None
            posts = Posts(grid, team, sight, surface, traversability)

            if bounds:
                passable = posts.with_room(passable)

            # Bounds.
            z = np.repeat(of_moves(cells, passable)[None], team.n_robots, axis=0)
            names = [*features]
            onward = None
            if bounds:
                z = with_line_of_sight(z, pixels, passable, posts, n_posts)
                names.append(LINE_OF_SIGHT)
            if n_posts > 1:
                onward = onward_maps(posts, passable, n_posts)

        maps = labelled(z, passable, grid, team, names)
        pixels = pixels.assign(passable=drivable)
        more = None if onward is None else labelled_onward(onward, maps[0])
        return cls(*maps, grid, team, terrain, pixels, composites, posts, more)

    @classmethod
    def from_awareness(
        cls,
        awareness: ArrayLike,
        passable: ArrayLike | None = None,
        cell_size: float = 50.0,
        *,
        team: Team | None = None,
        features: tuple[str, ...] = (),
    ) -> Self:
        """Make a workspace from arrays, without a terrain.

        Args:
            awareness: Awareness of each cell, shape (robot, row, col, feature), which applies to
                all moves into the cell; or awareness of each bound, shape (robot, move, row, col,
                feature), for the eight `MOVES` into the cell. Values are in [0, 1]. With n sets of
                posts, there are 8 n moves: those with the standard set, then those with the next.
            passable: Whether each cell is passable, shape (row, col). By default, a cell is
                passable if its awareness, or that of at least one bound into it, has no NaN.
            cell_size: Side length of a cell, in metres.
            team: Lead and overwatching robots; by default, `awareness` sets the number of robots.
            features: Names of the features; by default traversability, visibility, z3, ...

        Raises:
            TrustboError: The shapes do not match, a value is outside [0, 1], a passable cell has a
                NaN, or no cell is passable.
        """
        known = () if team is None else Team.of(team).names
        features = as_names("features", features)
        z, robots, features = unlabelled(awareness, known, features)
        z, free = of_arrays(z, passable)

        team = Team(len(z), names=robots) if team is None else Team.of(team)
        if len(team.robots) != len(z):
            n = len(team.robots)
            raise TrustboError(
                f"awareness has {len(z)} robots, but the team has {n}; the numbers must match."
            )

        names = features or default_features(z.shape[-1])
        if len(names) != z.shape[-1]:
            raise TrustboError(f"features must have {z.shape[-1]} names; got {names}.")

        side = require_positive("cell_size", cell_size)
        rows, cols = free.shape
        grid = Grid((rows, cols), 0.0, rows * side, side, side)
        return cls(*labelled(z, free, grid, team, names), grid, team)

    @property
    def features(self) -> tuple[str, ...]:
        """Names of the awareness features."""
        return tuple(str(name) for name in self.awareness["feature"].values)

    @property
    def n_posts(self) -> int:
        """Number of sets of posts for each bound."""
        return self.awareness.sizes["move"] // len(MOVES)

    @property
    def post_sets(self) -> tuple[str, ...]:
        """Names of the sets of posts, the standard one first."""
        return POST_SETS[: self.n_posts]

    def _rows(self) -> Rows:
        grid = self.grid
        free = self.passable.values
        team = self.team
        n_pixels = [] if self.terrain is None else self.terrain["dem"].shape

        spread = [(f"  {name}", self._middle_of(name)) for name in self.features]

        return [
            ("cells", f"{grid.shape[0]} x {grid.shape[1]}, {free.mean():.0%} passable"),
            ("cell", f"{grid.cell_height:.4g} m x {grid.cell_width:.4g} m"),
            ("CRS", grid.crs_name),
            ("team", f"a lead and {', '.join(team.names)}"),
            *([("posts", ", ".join(self.post_sets))] if self.n_posts > 1 else []),
            ("awareness", "of the middle 80 % of bounds"),
            *spread,
            ("sight", "none assumed" if self.sight is None else str(self.sight)),
            ("terrain", " x ".join(map(str, n_pixels)) + " pixels" if n_pixels else "none"),
            *((f"  {name}", self._place_text(name)) for name in self.places),
            *([("closed", closed_text(self.closed, self.name_of))] if self.closed else []),
        ]

    def _place_text(self, name: str) -> str:
        """Return where a place is, as text."""
        where = f"cell {path_text([self.locate(name)])}"
        return (
            where if self.posts is None else f"{where}, {self.from_stop(name):.0f} m from its stop"
        )

    def _middle_of(self, feature: str) -> str:
        """Return the range of a feature in the middle 80 % of bounds, as text."""
        values = self.awareness.sel(feature=feature).mean("robot").values
        known = values[np.isfinite(values)]
        if not len(known):
            return "no bounds"
        low, high = np.quantile(known, _MIDDLE)
        return f"{low:.2f} to {high:.2f}"

    def with_places(self, places: Mapping[str, Location]) -> "Workspace":
        """Return the workspace with names for places, which can be given instead of cells.

        A place stands for the cell that contains it. Missions begin and end at the stop of this
        cell, which may be some metres away; see `from_stop`. Tables, reports, maps and GeoJSON
        files show the names. Other places of the workspace are kept.

        Args:
            places: Cells or positions by name; see `locate`. A name must not contain "," or "=".

        Raises:
            TrustboError: A name is not a text or contains one of these signs, or a location is
                invalid, off the grid or impassable.

        Example:
            >>> workspace = workspace.with_places({"camp": (9, 1), "hill": {"x": x, "y": y}})
            >>> plan = tb.Campaign(workspace).ask("camp", "hill")
        """
        if self.within is not None:
            return self.within.with_places(places).of_robots(self.team.names)

        require_kind("places", places, Mapping, 'give names with locations, as {"camp": (9, 1)}')
        found = dict(self.places)
        for name, location in places.items():
            if not isinstance(name, str) or not name.strip() or {*name} & {*_NO_NAME}:
                raise TrustboError(
                    f'the name of a place must be a text without "," and "="; got {name!r}.'
                )
            what = f"place {name!r}"
            where = self._place(location, what) if isinstance(location, str) else location
            self.locate(where, what)
            found[composed(name)] = self.grid.position(where)
        return dataclasses.replace(self, places=found)

    def from_stop(self, name: str) -> float:
        """Return the distance of a place from the lead's stop in its cell, m; 0 without a terrain.

        Raises:
            TrustboError: There is no place of this name.
        """
        cell = self.locate(name)
        if self.posts is None:
            return 0.0
        return float(np.hypot(*(self.posts.stop(cell) - self.places[composed(name)])))

    def name_of(self, cell: Cell) -> str:
        """Return the name of the first place in a cell, or the cell as text, such as "9,1"."""
        return self.place_in.get(cell, path_text([cell]))

    @property
    def place_in(self) -> dict[Cell, str]:
        """Name of the first place in each cell that has one."""
        found: dict[Cell, str] = {}
        for name, (x, y) in self.places.items():
            found.setdefault(self.grid.locate({"x": x, "y": y}), name)
        return found

    def closing(self, where: Sequence[Any], reason: str = "") -> "Workspace":
        """Return the workspace with closed cells and bounds, which no path takes.

        No path enters a closed cell, but a team in it can leave it. A closed bound is taken in
        neither direction. Only paths change: `passable`, posts and routes are those of the ground,
        and what was learned on it remains valid. Robots of T2 may pass beside a closed cell.

        Args:
            where: Cells, and bounds as pairs of neighbouring cells. Instead of a cell, a position
                or the name of a place can be given; see `locate`.
            reason: Reason for messages, such as "wreck".

        Raises:
            TrustboError: A cell is off the grid or impassable, or the cells of a bound are not
                neighbours.

        Example:
            >>> detour = workspace.closing([(3, 4), ((2, 1), (1, 1))], reason="wreck")
            >>> plan = tb.Planner(detour, (9, 0), (0, 9)).plan(posterior)
        """
        return self.with_closed(self.closed | require_closed(where, reason, self.locate))

    def with_closed(self, closed: dict[tuple[Cell, ...], str]) -> "Workspace":
        """Return the workspace in which exactly these cells and bounds are closed."""
        if closed == self.closed:
            return self
        if self.within is not None:
            return self.within.with_closed(closed).of_robots(self.team.names)

        other = dataclasses.replace(self, closed=dict(closed))
        for name in ("passable_bounds", "difficulty"):  # slow, and the same
            vars(other)[name] = getattr(self, name)
        return other

    @property
    def open_bounds(self) -> np.ndarray:
        """Whether a path may take each bound, (move, row, col): it is passable and not closed."""
        bounds: np.ndarray = self.passable_bounds.values
        return bounds & ~closed_mask(self.closed, bounds.shape) if self.closed else bounds

    @property
    def whole(self) -> "Workspace":
        """Workspace of the whole team, which is this one unless robots stay at home."""
        return self if self.within is None else self.within

    def of_robots(self, names: Iterable[str]) -> "Workspace":
        """Return the same ground as seen by some robots of T2, while the others stay at home.

        The robots use the posts that are planned for the whole team. `passable_bounds` and
        `difficulty` are those of the whole team, too. The failure probability of a bound is
        therefore that of the whole team, and is too high if the robot that fails most stays at
        home.

        Args:
            names: Names of the robots, in any order; the result has the order of the workspace.

        Returns:
            Workspace with these robots, the same one for the same names. It is this workspace if
            no robot is left out.

        Raises:
            TrustboError: A name is unknown or repeated, or there are no names.

        Example:
            >>> two = workspace.of_robots(["r1", "r3"])
            >>> two.team.names
            ('r1', 'r3')
            >>> plan = tb.Planner(two, (9, 0), (0, 9)).plan(posterior)
        """
        team = self.team.of_robots(names)
        if team is self.team:
            return self

        if team.names not in self._parts:
            members = [self.team.names.index(name) for name in team.names]
            self._parts[team.names] = dataclasses.replace(
                self,
                awareness=self.awareness.isel(robot=members),
                team=team,
                posts=None if self.posts is None else self.posts.of_robots(team.names),
                onward=None if self.onward is None else self.onward.isel(robot=members),
                within=self.whole,
            )
        return self._parts[team.names]

    @cached_property
    def _parts(self) -> "dict[tuple[str, ...], Workspace]":
        """Results of `of_robots` so far."""
        return {}

    @property
    def surface(self) -> Surface | None:
        """Rasters used to compute positions, motion and sight; None without a terrain."""
        return None if self.posts is None else self.posts.surface

    @property
    def sight(self) -> Sight | None:
        """Model of sight assumed for posts and line of sight; None without a terrain."""
        return None if self.posts is None else self.posts.sight

    @cached_property
    def passable_bounds(self) -> xr.DataArray:
        """Boolean DataArray (move, row, col) that says whether the robots can drive each bound.

        A bound enters the cell (row, col) by one of the eight `MOVES`. Both cells must be passable
        and connected by routes within the two cells and half a cell around them. Without a terrain,
        any two neighbouring cells are connected.
        """
        if self.within is not None:
            return self.within.passable_bounds
        exists = existing_bounds(self.passable.values)
        if self.posts is not None:
            exists = self.posts.linked_bounds(exists)
        like = self.passable.expand_dims(move=list(MOVE_NAMES), axis=0)
        return fix(like.copy(data=exists).rename("passable_bounds"))

    @cached_property
    def difficulty(self) -> Difficulty:
        """Difficulty of the bounds, from the robots' routes; bounds are measured when needed."""
        if self.within is not None:
            return self.within.difficulty
        traversability = None
        if self.pixels is not None and TRAVERSABLE in self.pixels:
            traversability = self.pixels[TRAVERSABLE].values
        bounds = self.passable_bounds.values
        return Difficulty(bounds, self.posts, traversability, self.n_posts)

    def along(self, path: Sequence[Station], *, anywhere: bool = False) -> np.ndarray:
        """Return the awareness of a path's bounds, shape (bound, robot, feature), in [0, 1].

        Args:
            path: Cells, each a neighbour of the previous one; (row, col, name) for a set of posts
                other than the standard one.
            anywhere: Whether impassable cells are allowed; their awareness may be NaN.

        Raises:
            TrustboError: A cell is off the grid, impassable, or not a neighbour of the previous
                one.
        """
        require_switch("anywhere", anywhere)
        locate = self.grid.locate if anywhere else self.locate
        path = require_list("path", path, remedy="give cells (row, col)")
        if not path:
            raise TrustboError("path must contain at least one cell; got none.")

        cells = [self._station(station, f"path[{k}]", locate) for k, station in enumerate(path)]
        return np.swapaxes(self.of_pairs(pairs_along(cells, self.n_posts)), 0, 1)

    def of_pairs(self, pairs: np.ndarray) -> np.ndarray:
        """Return the awareness (robot, pair, feature) of bounds with given next ways.

        Args:
            pairs: Way, row, column and next way (pair, 4), where the next way is the number of ways
                at the end of a path; see `workspace.moves`.
        """
        way, row, col, after = pairs.T
        z = self.awareness.values[:, way, row, col]
        if self.onward is None:
            return z

        goes_on = after < len(self.onward["next_move"])
        change = self.onward.values[:, way, row, col, np.where(goes_on, after, 0)]
        seen = z[..., self.features.index(LINE_OF_SIGHT)]
        seen += np.where(goes_on, change, 0.0)
        return np.clip(z, 0.0, 1.0)

    def _station(self, station: Any, what: str, locate: Callable[[Any, str], Cell]) -> Station:
        """Find the cell of a station; raises TrustboError if its set of posts is not offered."""
        if not (isinstance(station, tuple | list) and len(station) == 3):
            return locate(station, what)

        name = require_choice(f"posts of {what}", station[2], self.post_sets)
        return *locate(tuple(station[:2]), what), name

    def with_threat(self, threat: xr.Dataset | None = None) -> "Workspace":
        """Return a workspace with the feature `threat`, the exposure of each bound to a threat.

        The exposure is 0 far from a threat and 1 at its place, averaged over a threat map. Trust
        is expected to fall by 0.5 per unit of it, so plans avoid the threat before they have
        learned its effect. Begin a campaign with `with_threat()`, in which the feature is 0. When a
        threat appears, go on with a new campaign that has the earlier one as `earlier`.

        Args:
            threat: Map of `planning.threat_map`; None for no threat.

        Raises:
            TrustboError: The map is that of another grid.

        Example:
            >>> workspace = workspace.with_threat()
            >>> campaign = tb.Campaign(workspace, (9, 0), (0, 9))
        """
        if self.within is not None:
            return self.within.with_threat(threat).of_robots(self.team.names)

        exposure = np.zeros(self.passable_bounds.shape)
        if threat is not None:
            exposure = exposure_of(self.grid, threat)
        of_ways = for_sets(exposure, self.n_posts)

        names = [name for name in self.features if name != THREAT]
        known = self.awareness.sel(feature=names)
        added = known.isel(feature=[0]).assign_coords(feature=[THREAT])
        exists = np.isfinite(added.values)
        values = np.where(exists, of_ways[None, ..., None], np.nan)
        awareness = xr.concat([known, added.copy(data=values)], "feature")
        return dataclasses.replace(self, awareness=awareness.rename("awareness"))

    def post_sets_of(
        self, path: Sequence[Cell], stood: ArrayLike, *, within: float = 10.0
    ) -> tuple[str, ...]:
        """Return the name of the set of posts nearest to where T2 stood before each bound.

        Robots that did not stand at the planned posts can thus tell a mission; only the set is
        learned from, not the positions.

        Args:
            path: Cells, each a neighbour of the previous one.
            stood: Positions of T2 at the beginning of each bound, shape (bound, robot, 2), x and y
                in CRS metres; NaN where unknown. If all are unknown, the posts are the standard
                ones.
            within: Largest distance between a robot and its post, m.

        Raises:
            TrustboError: The workspace has no terrain, the shape is wrong, or a robot stood farther
                than `within` from its posts of every set.

        Example:
            >>> stood = np.stack([bound.poses[0, 1:, :2] for bound in mission.bounds])
            >>> sets = workspace.post_sets_of(mission.path, stood)
            >>> mission = dataclasses.replace(mission, post_sets=sets)
        """
        if self.posts is None:
            raise TrustboError("post_sets_of needs the posts of a workspace made from a terrain.")

        cells = [self.locate((a[0], a[1]), f"path[{k}]") for k, a in enumerate(path)]
        places = np.asarray(stood, float)
        shape = (len(cells) - 1, self.team.n_robots, 2)
        if places.shape != shape:
            raise TrustboError(f"stood must be (bound, robot, 2) = {shape}; got {places.shape}.")

        require_positive("within", within)
        names: list[str] = []
        for k, (a, c) in enumerate(pairwise(cells)):
            posts = np.array([self.posts.watching((*a, name), c) for name in self.post_sets])
            away = np.nan_to_num(np.linalg.norm(posts - places[k], axis=-1))  # (set, robot)
            nearest = int(away.max(1).argmin())
            if away[nearest].max() > within:
                i = int(away[nearest].argmax())
                raise TrustboError(
                    f"{self.team.names[i]} stood {away[nearest, i]:.0f} m from its post of the set "
                    f"{self.post_sets[nearest]!r} in cell {a}, and no set is nearer; increase "
                    f"within = {within:g} m, offer more sets (n_posts), or leave this mission out."
                )
            names.append(self.post_sets[nearest])
        return tuple(names)

    def in_order(self, mission: Mission) -> Mission:
        """Return a mission with its robots and features in the workspace's order.

        Line of sight and the exposure to a threat are predicted, not measured, and are NaN if they
        are missing in the mission.
        Features with the default names z3, z4, ... get the workspace's names, in order.

        Raises:
            TrustboError: The mission has no map, or its robots or features do not match.
        """
        require_kind("mission", mission, Mission, "give a trustbo.Mission")
        require_map("a workspace", [mission])

        unnamed = default_features(len(mission.features))
        if mission.features == unnamed and len(unnamed) == len(self.features):
            named = tuple(
                feature if name not in FEATURES else name
                for name, feature in zip(unnamed, self.features, strict=True)
            )
            mission = dataclasses.replace(mission, features=named)

        predicted = [name for name in self.features if is_predicted(name)]
        return mission.in_order(self.team.names, self.features, predicted)

    def fill(self, mission: Mission) -> Mission:
        """Replace awareness that a mission did not measure (NaN) with the workspace's awareness.

        For example, robots do not measure line of sight. Campaigns fill missions automatically.

        Raises:
            TrustboError: The driven cells leave the grid, or are not neighbours.
        """
        ordered = self.in_order(mission)
        missing = np.isnan(ordered.awareness)
        if not missing.any():
            return ordered

        known = self.along(ordered.driven_stations, anywhere=True)
        return ordered.with_awareness(np.where(missing, known, ordered.awareness))

    def locate(self, location: Location, what: str = "location") -> Cell:
        """Find the passable cell at a location.

        Args:
            location: Cell (row, col); a position such as `{"x": 1748000.0, "y": 5427000.0}` in CRS
                metres or `{"lon": 174.7, "lat": -41.3}` in degrees (WGS 84); or the name of a place
                (see `with_places`).
            what: Name of the location in error messages.

        Raises:
            TrustboError: The location is invalid or off the grid, the cell is impassable, or there
                is no place of this name.
        """
        if isinstance(location, str):
            location = self._place(location, what)
        cell = self.grid.locate(location, what)
        grid = self.grid
        if not self.passable.values[cell]:
            free = np.argwhere(self.passable.values)
            steps = (free - cell) * (grid.cell_height, grid.cell_width)
            near = tuple(free[np.argmin(np.hypot(*steps.T))].tolist())
            raise TrustboError(
                f"{what} {cell} is impassable{self._why_impassable(cell)}; the nearest passable "
                f"cell is {near}."
            )
        return cell

    def _place(self, name: str, what: str) -> dict[str, float]:
        """Return the position of a place; raises TrustboError if there is none of this name."""
        if not self.places:
            raise TrustboError(
                f"{what} {name!r} is not known: the workspace has no places; give a cell or a "
                "position, or name the place with workspace.with_places."
            )
        x, y = self.places[require_choice(what, name, self.places)]
        return {"x": x, "y": y}

    def _why_impassable(self, cell: Cell) -> str:
        """Return, for a message, the reason why a cell is impassable; empty without a terrain."""
        if self.terrain is None:
            return ""

        missing = self.grid.cell_means(self.terrain["dem"].isnull().astype(float))[cell]
        if missing > MAX_MISSING:
            return f": {missing:.0%} of it has no data"

        if self.pixels is not None:
            drivable = self.grid.cell_means(self.pixels["passable"].astype(float))[cell]
            if drivable >= 1.0 - MAX_MISSING:
                return ": its passable pixels are too few for the team or cut off from the others"

        steep = np.rad2deg(self.team.max_slope)
        return f": over half of it is missing or steeper than {steep:.0f} degrees, the team's limit"
