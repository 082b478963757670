"""Figures as images embedded in a page."""

import base64
import io
import re
from collections.abc import Callable
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from PIL import Image as Raster
from PIL import features

from trustbo.plots.style import LIGHT
from trustbo.report.blocks import Picture

_PIXELS = 96
_DOTS = 160
"""Resolution of rasters such as maps, dots per inch."""
_PNG = re.compile(r"data:image/png;base64,([A-Za-z0-9+/=\s]+)")
_DIGITS = re.compile(r"(?<![\d.])([1-9]\d*\.\d\d)\d+")  # beyond a hundredth of a point
_BETWEEN = re.compile(r">\s+<")
_STYLE: dict[Any, Any] = {
    "svg.fonttype": "path",
    "svg.hashsalt": "trustbo",
    "figure.facecolor": LIGHT.paper,
    "axes.facecolor": LIGHT.paper,
    "savefig.facecolor": LIGHT.paper,
    "legend.facecolor": LIGHT.paper,
}
"""Fonts as outlines and names of elements are equal in all runs; paper is that of the page."""


def picture(draw: Callable[[], Axes | np.ndarray], alt: str, caption: str) -> Picture:
    """Make a picture of the figure that `draw` draws; `alt` is for those who cannot see it."""
    file = io.BytesIO()
    with plt.rc_context(_STYLE):
        axes = draw()
        first = axes if isinstance(axes, Axes) else axes.ravel()[0]
        figure = first.get_figure(root=True)
        assert figure is not None  # noqa: S101
        figure.set_dpi(_DOTS)
        # The same bytes as of `savefig`, which draws once more for the layout.
        FigureCanvasSVG(figure).print_svg(file, metadata={"Date": None})
    plt.close(figure)
    width, height = (round(_PIXELS * inches) for inches in figure.get_size_inches())
    svg = _PNG.sub(_smaller, file.getvalue().decode("utf-8"))
    svg = _BETWEEN.sub("><", _DIGITS.sub(r"\1", svg))
    text = base64.b64encode(svg.encode("utf-8")).decode("ascii")
    return Picture(alt, caption, f"data:image/svg+xml;base64,{text}", width, height)


def _smaller(png: re.Match[str]) -> str:
    """Return the raster in WebP, smaller than its PNG and with the same colours."""
    if not features.check("webp"):
        return png[0]
    file = io.BytesIO()
    with Raster.open(io.BytesIO(base64.b64decode(png[1]))) as raster:
        raster.save(file, "WEBP", lossless=True)
    return f"data:image/webp;base64,{base64.b64encode(file.getvalue()).decode('ascii')}"
