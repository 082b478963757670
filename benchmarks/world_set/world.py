"""Benchmark worlds: true and assumed terrain, sight model and team, and four courses."""

import hashlib
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, cast

import numpy as np
import xarray as xr
from scipy import ndimage

from trustbo import terrain
from trustbo.data import POST_SETS, Cell
from trustbo.errors import TrustboError, require_choice
from trustbo.files import FilePath, to_path
from trustbo.simulation import KinematicSimulator, RadioSimulator, Truth
from trustbo.simulation.events import Event
from trustbo.study import Scene
from trustbo.team import Team
from trustbo.terrain.examples import EXAMPLE_FILES
from trustbo.terrain.place import quiet_affine
from trustbo.workspace import Workspace
from trustbo.workspace.sight import Sight

REAL = ("wellington", "tahoe", "bcts", "topography")
"""Folder names of the real terrains; each folder contains dem.tif and dsm.tif."""
COURSES = ("sw-ne", "nw-se", "n-s", "w-e")
"""Courses (start and goal) of a world: both diagonals, north to south, and west to east."""
_STRIP = 250
"""Extent in y, in metres, to which a real terrain is cropped if it is more than twice as long."""
_RELIEF = 0.06
"""Height range of a synthetic terrain, as a fraction of its longer side."""
_PATCH = 10.0
"""Correlation length of the errors of an outdated survey, m."""
_CLEARED = 0.15
"""Share of the area without its canopy in an outdated survey."""
_CANOPY = 0.7
"""Height of the remaining canopy in an outdated survey, relative to the true height."""
_GROUND_ERROR = 0.3
"""Standard deviation of the ground errors of an outdated survey, m."""


def drawn(ground: str, what: str) -> np.random.Generator:
    """Make a generator seeded with the SHA-256 hash of a terrain's name and a purpose."""
    return np.random.default_rng(list(hashlib.sha256(f"{ground} {what}".encode()).digest()))


@dataclass(frozen=True)
class World:
    """Benchmark world: a terrain, its events, and the true and assumed sight model and team.

    Attributes:
        name: Name of the terrain, followed by the name of the case.
        kind: Name of a group of worlds, used as a label in tables.
        ground: Name of the terrain, `"synthetic-N"` for a synthetic terrain with seed N,
            `"synthetic-NAME"` for one whose seed is drawn from the name, or a name in `REAL`.
        sight: True sight model.
        assumed: Assumed sight model; None for the true model.
        team: True lead and robots.
        assumed_team: Assumed lead and robots; None for the true team.
        aged: Whether the assumed terrain comes from an outdated survey (see the function `aged`).
        events: Events in the true world. The centre of an event is a position relative to the
            terrain's lower left corner, in fractions of its width and height.
        shape: Shape of the planning grid, (row, col).
        cell: Side length of the planning cells on a synthetic terrain, in metres.
        radio: Whether contact is simulated by `RadioSimulator`.
        data: Folder with the real terrains.
    """

    name: str
    kind: str
    ground: str
    sight: Sight = field(default_factory=Sight)
    assumed: Sight | None = None
    team: Team = field(default_factory=Team)
    assumed_team: Team | None = None
    aged: bool = False
    events: tuple[Event, ...] = ()
    shape: tuple[int, int] = (10, 10)
    cell: float = 50.0
    radio: bool = False
    data: str | None = None

    @property
    def case(self) -> str:
        """Name of the case, or the kind if the name contains only the terrain."""
        return self.name.removeprefix(self.ground).removeprefix("-") or self.kind

    @property
    def is_made(self) -> bool:
        """Whether the terrain is synthetic; otherwise, it is read from files."""
        return self.ground.startswith("synthetic")

    @property
    def is_packaged(self) -> bool:
        """Whether the terrain comes with the package."""
        return self.is_made or self.ground == "wellington"

    def files(self) -> list[str]:
        """Return the DEM and DSM files of a real terrain.

        Raises TrustboError if files are missing; the message names the files that are needed.
        """
        if self.data is None and self.is_packaged:
            return list(EXAMPLE_FILES)

        folder = "" if self.data is None else to_path(self.data).absolute()
        files = [Path(folder, self.ground, f"{name}.tif") for name in ("dem", "dsm")]
        absent = [str(file) for file in files if self.data is None or not file.is_file()]
        if absent:
            raise TrustboError(
                f"world {self.name!r} needs {' and '.join(absent)}. Set data= to the folder that "
                f"contains {self.ground}/, or leave this world out."
            )

        return [str(file) for file in files]

    def true_terrain(self) -> xr.Dataset:
        """Return the true DEM and DSM."""
        if not self.is_made:
            return _read(*self.files())

        name = self.ground.partition("-")[2]
        seed = int(name) if name.isdigit() else int(drawn(self.ground, "terrain").integers(2**31))
        rows, cols = self.shape
        return _made(seed, (rows * self.cell, cols * self.cell))

    def workspace(self, **options: Any) -> Workspace:
        """Make the assumed workspace, by default with one set of posts, as in truths.

        Truths of three sets take eight times as long. `options` are passed to
        `Workspace.from_terrain`.
        """
        options = {"n_posts": 1, **options}
        # Worlds that differ only in what is true share a workspace in the cache.
        assumed = replace(
            self,
            name="",
            kind="",
            sight=self.assumed or self.sight,
            assumed=None,
            team=self.assumed_team or self.team,
            assumed_team=None,
            events=(),
            radio=False,
        )
        return _workspace(assumed, tuple(sorted(options.items())))

    def campaign_workspace(self) -> Workspace:
        """Make the assumed workspace with all sets of posts, as campaigns have them by default."""
        return self.workspace(n_posts=len(POST_SETS))

    def true_workspace(self) -> Workspace:
        """Make the workspace that a mission planner with a perfect map and team would have."""
        return replace(self, aged=False, assumed=None, assumed_team=None).workspace()

    def simulator(self, workspace: Workspace) -> KinematicSimulator | RadioSimulator:
        """Make a simulator of the true world; posts and routes are from the assumed workspace."""
        terrain = self.true_terrain()
        if self.radio:
            # The default seed is a hash of the heights, whose last bits depend on the processor.
            seed = int(drawn(self.ground, "radio").integers(2**31))
            return RadioSimulator(workspace, terrain=terrain, seed=seed)

        given = {"terrain": terrain, "sight": self.sight, "team": self.team}
        return KinematicSimulator(workspace, events=self._events(terrain), **given)

    def truth(self, folder: FilePath | None = None) -> Truth:
        """Return the truth of the simulator; `folder` caches it on disk."""
        return Truth.from_simulator(self.simulator(self.workspace()), folder=folder)

    def scene(
        self,
        course: str,
        folder: FilePath | None = None,
        max_bounds: int | str = "shortest+4",
        **options: Any,
    ) -> Scene:
        """Make the scene of a course for `run_grid`; `folder` caches the truth on disk.

        The `options` are those of `workspace`. Raises TrustboError for an unknown course or missing
        files.
        """
        workspace = self.workspace(**options)
        paths = {"max_bounds": max_bounds}
        labels = {"world": self.name, "kind": self.kind, "of": self.case, "course": course}

        simulator = self.simulator(workspace)
        truth = Truth.from_simulator(simulator, folder=folder)
        ends = self.ends(course)
        return Scene(workspace, simulator, *ends, truth, {"planner": paths}, labels, paths)

    def _events(self, terrain: xr.Dataset) -> list[Event]:
        """Return the events with their centres in CRS metres."""
        with quiet_affine():
            left, bottom, right, top = terrain.rio.bounds(recalc=True)
        corner = np.array([left, bottom])
        size = np.array([right - left, top - bottom])

        placed = []
        for event in self.events:
            share = getattr(event, "center", None)
            if share is not None:
                x, y = corner + share * size
                event = replace(cast(Any, event), center=(float(x), float(y)))
            placed.append(event)
        return placed

    def ends(self, course: str) -> tuple[Cell, Cell]:
        """Return the start and goal of a course, moved to the largest region of passable cells."""
        rows, cols = (n - 1 for n in self.shape)
        start, goal = {
            "sw-ne": ((rows, 0), (0, cols)),
            "nw-se": ((0, 0), (rows, cols)),
            "n-s": ((0, cols // 2), (rows, cols - cols // 2)),
            "w-e": ((rows - rows // 2, 0), (rows // 2, cols)),
        }[require_choice("course", course, COURSES)]

        regions: Any = ndimage.label(self.workspace().passable.values, np.ones((3, 3)))
        labels = regions[0]
        largest = np.argmax(np.bincount(labels.ravel())[1:]) + 1
        free = np.argwhere(labels == largest)

        def nearest(cell: Cell) -> Cell:
            row, col = free[np.argmin(((free - cell) ** 2).sum(1))]
            return int(row), int(col)

        return nearest(start), nearest(goal)


def aged(now: xr.Dataset) -> xr.Dataset:
    """Imitate an outdated survey of a terrain, with errors in the canopy and the ground.

    The canopy has 0.7 times its true height. On 15 % of the area, in patches of about 10 m, the
    canopy is missing. The ground errors have a standard deviation of 0.3 m and a correlation length
    of about 10 m.
    """
    rng = np.random.default_rng(0)
    step = abs(float(now["x"][1] - now["x"][0]))
    dem = now["dem"].values
    dsm = now["dsm"].values

    def noise() -> np.ndarray:
        smooth = ndimage.gaussian_filter(rng.standard_normal(dem.shape), _PATCH / step)
        return smooth / smooth.std()

    clearings = noise()
    clearings = clearings > np.quantile(clearings, 1.0 - _CLEARED)
    ground = dem + _GROUND_ERROR * noise()
    canopy = np.where(clearings, 0.0, _CANOPY * (dsm - dem))

    old = now["dem"].copy(data=ground), now["dsm"].copy(data=ground + canopy)
    return terrain.read_terrain(*(heights.rio.write_crs(now.rio.crs) for heights in old))


@lru_cache(maxsize=4)
def _workspace(assumed: World, given: tuple[tuple[str, Any], ...]) -> Workspace:
    """Make the workspace from the assumed terrain, sight model and team."""
    ground = assumed.true_terrain()
    ground = aged(ground) if assumed.aged else ground
    options: dict[str, Any] = {"sight": assumed.sight, **dict(given)}
    return Workspace.from_terrain(ground, assumed.shape, assumed.team, **options)


@lru_cache(maxsize=2)
def _made(seed: int, size: tuple[float, float]) -> xr.Dataset:
    return terrain.synthetic_terrain(size, seed=seed, relief=_RELIEF * max(size))


@lru_cache(maxsize=2)
def _read(dem: str, dsm: str) -> xr.Dataset:
    whole = terrain.read_terrain(dem, dsm)
    step = abs(float(whole["y"][1] - whole["y"][0]))
    n_rows = round(_STRIP / step)
    if whole.sizes["y"] <= 2 * n_rows:
        return whole

    with_data = np.isfinite(whole["dem"].values).sum(1)
    first = int(np.convolve(with_data, np.ones(n_rows), "valid").argmax())
    return whole.isel(y=slice(first, first + n_rows))
