"""Changes of the world between missions: threats that appear, lidars that degrade."""

from collections.abc import Sequence
from dataclasses import dataclass
from numbers import Real

import numpy as np
from rasterio.features import geometry_mask
from rasterio.transform import Affine

from trustbo.errors import TrustboError, require_choice, require_positive, require_whole
from trustbo.workspace.surface import Surface

KINDS = ("jam", "forbid")


@dataclass(frozen=True)
class Threat:
    """Region that jams sight, or that no robot may enter, in some missions.

    Attributes:
        kind: `"jam"`: detection from or of a robot inside is 1 - `strength` times as probable;
            `"forbid"`: no route leads through.
        center: x and y of a circle, CRS metres.
        radius: Radius of the circle, m.
        polygon: Corners (x, y) of a region instead of a circle.
        strength: Strength of a jam, in (0, 1].
        first_mission: First mission with the threat; missions count from 0.
        last_mission: Last mission with the threat; None: no last.

    Raises:
        TrustboError: Neither a circle nor a polygon, an unknown kind, or a value out of range.
    """

    kind: str
    center: tuple[float, float] | None = None
    radius: float | None = None
    polygon: Sequence[tuple[float, float]] | None = None
    strength: float = 1.0
    first_mission: int = 0
    last_mission: int | None = None

    def __post_init__(self) -> None:
        require_choice("threat", self.kind, KINDS)
        require_missions(self.first_mission, self.last_mission)
        given = [value is not None for value in (self.center, self.radius, self.polygon)]
        if given not in ([True, True, False], [False, False, True]):
            raise TrustboError("a threat is either a circle, center and radius, or a polygon.")
        if self.polygon is None:
            require_positive("radius", self.radius)
            if not _are_positions(self.center, 1):
                raise TrustboError(f"center must be x and y in CRS metres; got {self.center!r}.")
        elif not _are_positions(self.polygon, 2) or len(self.polygon) < 3:
            raise TrustboError(
                f"a polygon needs three corners (x, y) in CRS metres; got {self.polygon!r}."
            )
        if not isinstance(self.strength, Real) or not 0.0 < self.strength <= 1.0:
            raise TrustboError(f"strength must be in (0, 1]; got {self.strength!r}.")

    def mask(self, surface: Surface) -> np.ndarray:
        """Pixels with centres inside, shape (row, col)."""
        rows, cols = surface.ground.shape
        if self.polygon is not None:
            height, width = surface.pixel
            corner = Affine.translation(
                surface.origin[0] - width / 2, surface.origin[1] + height / 2
            )
            shape = {"type": "Polygon", "coordinates": [[*self.polygon, self.polygon[0]]]}
            transform = corner @ Affine.scale(width, -height)
            return geometry_mask([shape], (rows, cols), transform, invert=True)
        x, y = self.center or (0.0, 0.0)
        row, col = surface.to_pixel(np.asarray(x), np.asarray(y))
        away = np.hypot(
            (np.arange(rows)[:, None] - row) * surface.pixel[0],
            (np.arange(cols) - col) * surface.pixel[1],
        )
        return away <= (self.radius or 0.0)


@dataclass(frozen=True)
class Degradation:
    """Lidar of a robot of T2 that is worse in some missions.

    Attributes:
        robot: Name of the robot.
        detection: Factor on the probability of detection, in [0, 1].
        first_mission, last_mission: Missions with the worse lidar, see `Threat`.

    Raises:
        TrustboError: A value out of range.
    """

    robot: str
    detection: float
    first_mission: int = 0
    last_mission: int | None = None

    def __post_init__(self) -> None:
        require_missions(self.first_mission, self.last_mission)
        if not isinstance(self.detection, Real) or not 0.0 <= self.detection <= 1.0:
            raise TrustboError(f"detection must be in [0, 1]; got {self.detection!r}.")


def acts_in(event: Threat | Degradation, mission: int) -> bool:
    """Whether the event acts in a mission."""
    last = event.last_mission
    return event.first_mission <= mission and (last is None or mission <= last)


def require_events(what: str, events: object, kind: type) -> None:
    """Check that `events` is a list of one kind of event: TrustboError if not."""
    if not isinstance(events, Sequence) or not all(isinstance(event, kind) for event in events):
        raise TrustboError(f"{what} must be a list, [{kind.__name__}(...)]; got {events!r}.")


def _are_positions(value: object, ndim: int) -> bool:
    """Whether it is one position (x, y), or with 2 dimensions many."""
    try:
        xy = np.asarray(value)
    except ValueError:  # unequal numbers of coordinates
        return False
    right = xy.ndim == ndim and xy.shape[-1] == 2 and xy.dtype.kind in "iuf"
    return right and bool(np.isfinite(xy).all())


def require_missions(first: int, last: int | None) -> None:
    """Check that two numbers are a range of missions: TrustboError if not."""
    require_whole("first_mission", first, 0)
    if last is not None:
        require_whole("last_mission", last, first)
