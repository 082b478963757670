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
from matplotlib.figure import Figure
from PIL import Image as Raster
from PIL import features

from trustbo.report.blocks import Image, Picture

PHONE = 3.55
"""Width of figures for phones, inches of 96 CSS pixels, a little less than the screen."""
_PIXELS = 96
_DOTS, _QUALITY = 160, 75
"""Resolution of rasters such as hillshades, dots per inch, and their quality in WebP."""
_PNG = re.compile(r"data:image/png;base64,([A-Za-z0-9+/=\s]+)")
_DIGITS = re.compile(r"(?<![\d.])([1-9]\d*\.\d\d)\d+")  # beyond a hundredth of a point
_BETWEEN = re.compile(r">\s+<")
_STYLE: dict[Any, Any] = {
    "svg.fonttype": "path",
    "svg.hashsalt": "trustbo",
    "figure.facecolor": "white",
}
"""Fonts as outlines, equal on all machines; names of elements equal in all runs."""

Draw = Callable[[int | None], Axes | np.ndarray]
"""Function that draws a figure with a given number of panels per row; None for its default."""


def picture(
    draw: Draw, alt: str, caption: str, *, phone_columns: int = 1, shrink: bool = False
) -> Picture:
    """Draw a figure twice, for pages and for phones, with so many panels per row there.

    With `shrink`, panels keep their proportions on phones, as maps do. `alt` describes the figure
    to readers who cannot see it.
    """
    with plt.rc_context(_STYLE):
        wide, narrow = _figure(draw(None)), _figure(draw(phone_columns))
        width, height = narrow.get_size_inches()
        narrow.set_size_inches(PHONE, height * PHONE / width if shrink else height)
        return Picture(alt, caption, _image(wide), _image(narrow))


def _figure(axes: Axes | np.ndarray) -> Figure:
    first = axes if isinstance(axes, Axes) else axes.ravel()[0]
    figure = first.get_figure(root=True)
    return figure  # pyright: ignore[reportReturnType]


def _image(figure: Figure) -> Image:
    file = io.BytesIO()
    figure.set_dpi(_DOTS)
    # The same bytes as of `savefig`, which draws once more to know its layout.
    FigureCanvasSVG(figure).print_svg(file, metadata={"Date": None})
    plt.close(figure)
    width, height = (round(_PIXELS * inches) for inches in figure.get_size_inches())
    svg = _PNG.sub(_smaller, file.getvalue().decode("utf-8"))
    svg = _BETWEEN.sub("><", _DIGITS.sub(r"\1", svg))
    text = base64.b64encode(svg.encode("utf-8")).decode("ascii")
    return Image(f"data:image/svg+xml;base64,{text}", width, height)


def _smaller(png: re.Match[str]) -> str:
    """Return the raster in WebP, where a hillshade has a tenth of the size of its PNG."""
    if not features.check("webp"):
        return png[0]
    file = io.BytesIO()
    with Raster.open(io.BytesIO(base64.b64decode(png[1]))) as raster:
        raster.save(file, "WEBP", quality=_QUALITY)
    return f"data:image/webp;base64,{base64.b64encode(file.getvalue()).decode('ascii')}"
