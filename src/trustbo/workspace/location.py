"""Locations in user coordinates: cells, positions in metres of a CRS, longitude and latitude."""

import math
import re
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from rasterio.crs import CRS
from rasterio.warp import transform as transform_points
from rasterio.warp import transform_bounds

from trustbo.data import Cell
from trustbo.errors import TrustboError, require_pair

if TYPE_CHECKING:
    from trustbo.workspace.grid import Grid

type Location = Cell | str | Mapping[str, float]
"""A cell (row, col); or a mapping of the names row and col, x and y, or lon and lat to numbers; or
the same as text, "9,0", "x=1748000,y=5427000", "lon=174.7,lat=-41.3"."""

WGS84 = CRS.from_epsg(4326)
CELL, METRES, DEGREES = ("row", "col"), ("x", "y"), ("lon", "lat")
_SPELLINGS = (
    "A cell is 9,0; a position is x=1748000,y=5427000 in metres of the CRS, or lon=174.7,lat=-41.3 "
    "in degrees (in Python also a mapping of these names)."
)


class Named(NamedTuple):
    """Location whose numbers have names.

    Attributes:
        names: `CELL`, `METRES` or `DEGREES`.
        values: Number of each name.
        typed: Location in the user's spelling, for messages.
    """

    names: tuple[str, str]
    values: tuple[float, float]
    typed: str

    @property
    def text(self) -> str:
        """Text that `named` reads."""
        if self.names == CELL:
            return f"{self.values[0]},{self.values[1]}"
        return ",".join(f"{n}={v:.12g}" for n, v in zip(self.names, self.values, strict=True))


def named(what: str, location: object) -> Named:
    """Parse a location into named numbers.

    A bare pair is a cell: positions need names, so that nothing is guessed. TrustboError: neither a
    pair of whole numbers nor two numbers with the names of one spelling.
    """
    given = _of_text(location) if isinstance(location, str) else location
    if not isinstance(given, Mapping):
        try:
            pair = require_pair(what, given)
        except TrustboError:
            raise TrustboError(
                f"{what} must be two whole numbers (row, col), or a position with names; got "
                f"{location!r}. {_SPELLINGS}"
            ) from None
        return Named(CELL, pair, repr(location if isinstance(location, str) else pair))
    values = {str(name).strip().lower(): value for name, value in given.items()}
    for names in (CELL, METRES, DEGREES):
        if values.keys() == set(names) and len(values) == len(given):
            first, second = (_number(what, name, values[name], names == CELL) for name in names)
            parsed = Named(names, (first, second), "")
            return parsed._replace(
                typed=repr(location if isinstance(location, str) else parsed.text)
            )
    raise TrustboError(
        f"{what} must have the names row and col, x and y, or lon and lat; got {location!r}. "
        f"{_SPELLINGS}"
    )


def cell_of(
    what: str,
    location: object,
    grid: "Grid",
    passable: np.ndarray | None = None,
    why: Callable[[int, int], str] = lambda row, col: "",
) -> Cell:
    """Cell of a location on a grid; refused if it is impassable, unless that is unknown.

    Args:
        what: Name of the location, for messages.
        location: Location, see `Location`.
        grid: Grid of the cells.
        passable: Whether each cell is passable, (row, col); None where passability is unknown.
        why: Function of a row and a column that gives the reason of an impassable cell.

    Raises:
        TrustboError: The location is none, off the grid, or impassable; degrees on a grid without a
            CRS. The message has the location as typed and parsed, the extent, and the nearest cell.
    """
    parsed = _named_on(grid, what, location)
    cell = _cell(grid, parsed.names, parsed.values)
    shown = _understood(parsed, grid)
    if cell is None:
        rows, cols = grid.shape
        raise TrustboError(
            f"{what} {shown} is outside the grid of {rows} rows and {cols} columns; rows are "
            f"0..{rows - 1} from the top, columns 0..{cols - 1}{extent(grid, ', ')}."
            f"{_otherwise(parsed, grid)}{_nearest(parsed, grid, passable)}"
        )
    if passable is not None and not passable[cell]:
        within = "" if parsed.names == CELL else f", in cell {cell},"
        near = _nearest(parsed, grid, passable).removesuffix(".")
        near = near.replace(" The", " the", 1).replace(" No", " no", 1)
        raise TrustboError(
            f"{what} {shown}{within} is impassable{why(*cell)};{near}"
            f"{extent(grid, '. The grid has ')}."
        )
    return cell


def position_near(what: str, location: object, grid: "Grid", reach: float) -> tuple[float, float]:
    """X and y of a location in CRS metres, at most `reach` metres from a grid.

    TrustboError: it is none, or farther; the message has the same parts as that of `cell_of`.
    """
    parsed = _named_on(grid, what, location)
    position = position_of(grid, parsed.names, parsed.values)
    far, (left, bottom, right, top) = math.inf, grid.bounds
    if position is not None:
        x, y = position
        far = math.hypot(max(left - x, x - right, 0.0), max(bottom - y, y - top, 0.0))
    if position is None or far > reach:
        away = "not near the grid" if position is None else f"{far / 1e3:.0f} km from the grid"
        raise TrustboError(
            f"{what} {_understood(parsed, grid)} is {away}{extent(grid, ', ')}."
            f"{_otherwise(parsed, grid)}{_nearest(parsed, grid, None)}"
        )
    return float(position[0]), float(position[1])


def _named_on(grid: "Grid", what: str, location: object) -> Named:
    """Parse a location; the error suggests the spelling that is on the grid."""
    try:
        return named(what, location)
    except TrustboError as error:
        raise TrustboError(f"{error}{_names_for(location, grid)}") from None


def extent(grid: "Grid", before: str = "") -> str:
    """Text of the extent of a grid in its CRS and in degrees; empty without a CRS."""
    if grid.crs is None:
        return ""
    x, y, lon, lat = spans(grid)
    return f"{before}{x} and {y} m in {crs_name(grid)}, {lon} and {lat}"


def spans(grid: "Grid") -> tuple[str, str, str, str]:
    """Texts of the extent of a grid with a CRS, along x, y, longitude and latitude."""
    bounds = grid.bounds
    degrees = transform_bounds(CRS.from_user_input(grid.crs), WGS84, *bounds)
    (left, bottom, right, top), (west, south, east, north) = bounds, degrees
    return (
        f"x {left:.1f} to {right:.1f}",
        f"y {bottom:.1f} to {top:.1f}",
        f"longitude {west:.5f} to {east:.5f}",
        f"latitude {south:.5f} to {north:.5f}",
    )


def crs_name(grid: "Grid") -> str:
    """Short name of a grid's CRS, such as EPSG:2193."""
    return "no CRS" if grid.crs is None else name_of_crs(grid.crs)


def name_of_crs(given: object) -> str:
    """Short name of a CRS, such as EPSG:2193."""
    crs = CRS.from_user_input(given)
    code = crs.to_epsg()
    return f"EPSG:{code}" if code else re.findall(r'"(.*?)"', crs.to_wkt())[0]


def _of_text(text: str) -> object:
    """Mapping, or list, of the numbers of a text; the text itself where it is neither."""
    words = [word for word in re.split(r",\s*|\s+", text.strip()) if word]
    if all("=" in word for word in words):
        pairs = [word.split("=", 1) for word in words]
        return dict(pairs) if len(dict(pairs)) == len(pairs) else text
    try:
        return [int(word) for word in words]
    except ValueError:
        return text


def _number(what: str, name: str, value: object, whole: bool) -> float:
    try:
        number = float(value)  # pyright: ignore[reportArgumentType]
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number) or isinstance(value, bool) or (whole and number % 1.0):
        kind = "a whole number" if whole else "a finite number"
        raise TrustboError(f"{what}: {name} must be {kind}; got {value!r}.")
    return int(number) if whole else number


def position_of(
    grid: "Grid", names: tuple[str, str], values: Iterable[float]
) -> tuple[float, float] | None:
    """X and y of a location, CRS metres; None for degrees that are no place of the CRS."""
    a, b = values
    if names == METRES:
        return a, b
    if names == CELL:
        return grid.center((a, b))  # pyright: ignore[reportArgumentType]  # beyond the grid, too
    crs = grid.require_crs()
    if not (-180.0 <= a <= 360.0 and -90.0 <= b <= 90.0):
        return None
    return _moved(WGS84, crs, a, b)


def lonlat_of(grid: "Grid", position: tuple[float, float]) -> tuple[float, float]:
    """Longitude and latitude of a position in CRS metres; TrustboError without a CRS, or off it."""
    moved = _moved(grid.require_crs(), WGS84, *position)
    if moved is None:
        raise TrustboError(
            f"({position[0]:.10g}, {position[1]:.10g}) is no place on Earth in {crs_name(grid)}; "
            "give the terrain the CRS that its coordinates are in."
        )
    return moved


def _moved(source: CRS, target: CRS, x: float, y: float) -> tuple[float, float] | None:
    """Position in another CRS; None if it is no place on Earth in one of them."""
    try:
        (u,), (v,) = transform_points(source, target, [x], [y])[:2]
    except Exception:  # PROJ's errors are GDAL's, without a common base
        return None
    return (u, v) if np.isfinite([u, v]).all() else None


def _cell(grid: "Grid", names: tuple[str, str], values: Iterable[float]) -> Cell | None:
    """Cell of a location; None off the grid."""
    a, b = values
    if names == CELL:
        row, col = a, b
    elif (position := position_of(grid, names, (a, b))) is None:
        return None
    else:
        x, y = position
        row = np.floor((grid.top - y) / grid.cell_height)
        col = np.floor((x - grid.left) / grid.cell_width)
    rows, cols = grid.shape
    return (int(row), int(col)) if 0 <= row < rows and 0 <= col < cols else None


def _understood(parsed: Named, grid: "Grid") -> str:
    """Text of a location in the user's spelling and as parsed."""
    (a, b), names = parsed.values, parsed.names
    if names == CELL:
        is_pair = parsed.typed.startswith("(")
        return parsed.typed if is_pair else f"{parsed.typed} (row {a}, column {b})"
    if names == METRES:
        return f"{parsed.typed} (x {a:.1f}, y {b:.1f} m in {crs_name(grid)})"
    position = position_of(grid, names, (a, b))
    there = "no place of the CRS" if position is None else "x {:.1f}, y {:.1f} m".format(*position)
    return f"{parsed.typed} (longitude {a:g}, latitude {b:g}, {there})"


def _otherwise(parsed: Named, grid: "Grid") -> str:
    """Sentence that names the spelling under which the same two numbers are on the grid."""
    a, b = parsed.values
    for names in dict.fromkeys((parsed.names, CELL, METRES, DEGREES)):
        if names == DEGREES and grid.crs is None:
            continue
        for values in ((a, b), (b, a)):
            cell = _cell(grid, names, values)
            if cell is None or (names == CELL and any(v % 1.0 for v in values)):
                continue
            was = f"Were {names[0]} and {names[1]} swapped? " if values != (a, b) else ""
            return f" {was}{Named(names, values, '').text} is in cell {cell}."
    return ""


def _names_for(location: object, grid: "Grid") -> str:
    """Sentence that names the spelling under which a bare pair of numbers is on the grid."""
    words = re.split(r",\s*|\s+", location.strip()) if isinstance(location, str) else location
    try:
        a, b = (float(word) for word in words)  # pyright: ignore[reportGeneralTypeIssues]
    except (TypeError, ValueError):
        return ""
    return _otherwise(Named(CELL, (a, b), ""), grid) if math.isfinite(a + b) else ""


def _nearest(parsed: Named, grid: "Grid", passable: np.ndarray | None) -> str:
    """Sentence that names the nearest (passable) cell, and its distance if that is long."""
    position, turned = position_of(grid, parsed.names, parsed.values), ""
    if position is None:
        position = position_of(grid, parsed.names, parsed.values[::-1])
        turned = " of lon and lat swapped"
    if position is None:
        return ""
    cells = np.argwhere(np.ones(grid.shape, bool) if passable is None else passable)
    if not len(cells):
        return " No cell is passable: use other cells, or a team with a larger max_slope."
    x, y = grid.x[cells[:, 1]], grid.y[cells[:, 0]]
    distance = np.hypot(x - position[0], y - position[1])
    k = int(np.argmin(distance))
    row, col = cells[k].tolist()
    km = distance[k] / 1e3
    far = f", {km:.0f} km away" if km > 1.0 and parsed.names != CELL else ""
    text = "" if grid.crs is None else f" at x={x[k]:.1f},y={y[k]:.1f}"
    kind = f"{'cell' if passable is None else 'passable cell'}{turned}"
    return f" The nearest {kind} is {(row, col)}{text}{far}."
