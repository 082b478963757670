"""Small pictures as SVG, in the page's text colour: maps of cells with paths, and curves."""

import base64
import io
from collections.abc import Sequence
from html import escape

import numpy as np
from numpy.typing import ArrayLike

_UNKNOWN = (128, 128, 128, 255)
_WIDTH, _HEIGHT = 240.0, 150.0  # px, of the largest map and of a curve


def map_picture(
    values: ArrayLike,
    path: Sequence[tuple[int, int]] = (),
    *,
    aspect: float = 1.0,
    label: str = "",
    line: bool = True,
    apart: tuple[int, int] | None = None,
) -> str:
    """Draw cells (row, col) in colours, those without a value grey, with a path over them.

    Args:
        values: Values of the cells, NaN where there is none.
        path: Cells (row, col) of a path, from the dot to the star.
        aspect: Height of a cell over its width.
        label: Name of the values, written below with the least and the largest.
        line: False for the ends of the path alone.
        apart: Cell that is drawn grey too, and does not set the limits of the colours.
    """
    cells = np.array(values, dtype=float)
    if apart is not None:
        cells[apart] = np.nan
    rows, cols = cells.shape
    scale = min(_WIDTH / cols, _WIDTH / (rows * aspect))
    width, height = cols * scale, rows * aspect * scale
    limits = cells[np.isfinite(cells)]
    low, high = (float(limits.min()), float(limits.max())) if limits.size else (0.0, 0.0)
    parts = [
        f'<image width="{width:.0f}" height="{height:.0f}" preserveAspectRatio="none" '
        f'style="image-rendering:pixelated" href="{_png(cells, low, high)}"/>'
    ]
    if path:
        points = [((c + 0.5) * scale, (r + 0.5) * scale * aspect) for r, c in path]
        along = _points(points)
        for colour, thick in (("#000", 4), ("#fff", 2)) if line else ():
            parts.append(
                f'<polyline points="{along}" fill="none" stroke="{colour}" stroke-width="{thick}" '
                'stroke-linejoin="round"/>'
            )
        ends = ((points[0], 4.5), (points[-1], 6.0))
        parts += [_circle(*ends[0][0], ends[0][1]), _star(*ends[1][0], ends[1][1])]
    legend = f"{label}: {low:.3g} to {high:.3g}" if label else ""
    return _svg(width, height, parts, legend)


def curve_picture(
    curves: ArrayLike,
    *,
    band: tuple[ArrayLike, ArrayLike] | None = None,
    label: str = "",
    x_label: str = "",
) -> str:
    """Draw curves (curve, point) over 1, 2, ..., the first thick, with a band around it.

    NaN interrupts a curve; a single point is a dot.
    """
    lines = np.atleast_2d(np.asarray(curves, dtype=float))
    shown = [lines.ravel(), *(np.ravel(edge) for edge in band or ())]
    finite = np.concatenate(shown)
    finite = finite[np.isfinite(finite)]
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)
    if high - low < 1e-9:
        low, high = low - 0.05, high + 0.05
    n, left, top = lines.shape[1], 40.0, 8.0
    wide, tall = _WIDTH - left - 8.0, _HEIGHT - top - 30.0

    def position(k: int, value: float) -> tuple[float, float]:
        x = left + wide * (k / (n - 1) if n > 1 else 0.5)
        return x, top + tall * (high - value) / (high - low)

    parts = [
        f'<path d="M{left},{top}V{top + tall}H{left + wide}" fill="none" stroke="currentColor" '
        'stroke-opacity=".5"/>',
        *(
            f'<text x="{left - 4}" y="{y + 4}" text-anchor="end">{value:.3g}</text>'
            for value, y in ((high, top), (low, top + tall))
        ),
        f'<text x="{left}" y="{top + tall + 14}">{f"{x_label} 1".strip()}</text>',
    ]
    if n > 1:
        last = f'<text x="{left + wide}" y="{top + tall + 14}" text-anchor="end">{n}</text>'
        parts.append(last)
    if band is not None:
        below, above = (np.ravel(np.asarray(edge, dtype=float)) for edge in band)
        there = [position(k, value) for k, value in enumerate(below)]
        back = [position(k, value) for k, value in enumerate(above)][::-1]
        ring = _points(there + back)
        parts.append(f'<polygon points="{ring}" fill="#0072B2" fill-opacity=".25"/>')
    for i, line in enumerate(lines):
        style = "2" if i == 0 else '1" stroke-opacity=".5'
        for run in _runs(line):
            points = [position(k, line[k]) for k in run]
            parts.append(
                f'<polyline points="{_points(points)}" fill="none" stroke="#0072B2" '
                f'stroke-width="{style}"/>'
            )
            if i == 0 and n <= 40:
                parts += [_circle(*point, 2.0, "#0072B2") for point in points]
    return _svg(_WIDTH, _HEIGHT - 12.0, parts, label)


def _svg(width: float, height: float, parts: list[str], legend: str) -> str:
    below = 16.0 if legend else 0.0
    text = (
        f'<text x="0" y="{height + 12:.0f}">{escape(legend, quote=False)}</text>' if legend else ""
    )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:.0f}" '
        f'height="{height + below:.0f}" viewBox="0 0 {width:.0f} {height + below:.0f}" '
        'font-size="11" font-family="sans-serif" fill="currentColor" role="img">'
        f"{''.join(parts)}{text}</svg>"
    )


def _png(cells: np.ndarray, low: float, high: float) -> str:
    """Cells as a data URL, a pixel for each."""
    import matplotlib as mpl  # slow to import, and needed for display only
    from PIL import Image

    share = (cells - low) / (high - low) if high > low else np.where(np.isfinite(cells), 0.5, cells)
    pixels = mpl.colormaps["viridis"](np.nan_to_num(np.clip(share, 0.0, 1.0)), bytes=True)
    pixels[~np.isfinite(cells)] = _UNKNOWN
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "PNG")
    return "data:image/png;base64," + base64.b64encode(file.getvalue()).decode()


def _points(points: Sequence[tuple[float, float]]) -> str:
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in points)


def _runs(line: np.ndarray) -> list[np.ndarray]:
    """Indices of the stretches without NaN."""
    finite = np.flatnonzero(np.isfinite(line))
    return [run for run in np.split(finite, np.flatnonzero(np.diff(finite) > 1) + 1) if len(run)]


def _circle(x: float, y: float, radius: float, colour: str = "#fff") -> str:
    edge = ' stroke="#000"' if colour == "#fff" else ""
    return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius}" fill="{colour}"{edge}/>'


def _star(x: float, y: float, radius: float) -> str:
    angles = -np.pi / 2 + np.arange(10) * np.pi / 5
    reach = radius * np.where(np.arange(10) % 2, 0.45, 1.0)
    corners = zip(x + reach * np.cos(angles), y + reach * np.sin(angles), strict=True)
    return f'<polygon points="{_points(list(corners))}" fill="#fff" stroke="#000"/>'
