"""Layer style (.qml) with the colours of a raster in QGIS."""

import math
from xml.etree import ElementTree as ET

import numpy as np

from trustbo.export.checks import Maps, as_dataset
from trustbo.export.colours import VIRIDIS
from trustbo.files import FilePath, require_file, write_text

_HEAD = "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n"


def write_style(path: FilePath, maps: Maps) -> None:
    """Write the style of a raster of `write_geotiff`: viridis over the values of its first band.

    QGIS loads the style with the name of a raster from the same folder. NaN is left out of the
    limits of the colours. ShapeError: no maps. TrustboError: a file that cannot be written.
    """
    target = require_file(path, ".qml")
    shown, *_ = as_dataset(maps).data_vars.values()
    low, high = _limits(shown.values)
    root = ET.Element("qgis", version="3.28.0-Firenze", styleCategories="Symbology")
    pipe = ET.SubElement(root, "pipe")
    nearest = {f"zoomed{way}ResamplingMethod": "nearestNeighbour" for way in ("In", "Out")}
    provider = ET.SubElement(pipe, "provider")
    ET.SubElement(provider, "resampling", nearest, enabled="false", maxOversampling="2")
    limits = {"classificationMin": repr(low), "classificationMax": repr(high)}
    of_band = {"band": "1", "alphaBand": "-1", "opacity": "1"}
    kind = {"type": "singlebandpseudocolor", "nodataColor": ""}
    renderer = ET.SubElement(pipe, "rasterrenderer", kind | of_band | limits)
    ET.SubElement(renderer, "rasterTransparency")
    origin = ET.SubElement(renderer, "minMaxOrigin")
    # "None": the limits are those given here, not those of the visible part.
    for tag, text in {"limits": "None", "extent": "WholeRaster", "statAccuracy": "Exact"}.items():
        ET.SubElement(origin, tag).text = text
    renderer.append(_shader(low, high))
    ET.SubElement(pipe, "brightnesscontrast", brightness="0", contrast="0", gamma="1")
    ET.SubElement(pipe, "huesaturation", saturation="0", grayscaleMode="0", colorizeOn="0")
    ET.SubElement(pipe, "rasterresampler", maxOversampling="2")
    ET.SubElement(root, "blendMode").text = "0"
    ET.indent(root)
    write_text(target, _HEAD + ET.tostring(root, encoding="unicode") + "\n")


def _shader(low: float, high: float) -> ET.Element:
    """Return the colours by value, and the ramp that QGIS shows for editing."""
    shader = ET.Element("rastershader")
    ramp = ET.SubElement(
        shader,
        "colorrampshader",
        colorRampType="INTERPOLATED",
        classificationMode="2",  # stops at equal intervals
        clip="0",
        labelPrecision=str(_decimals(low, high)),
        minimumValue=repr(low),
        maximumValue=repr(high),
    )
    source = ET.SubElement(ramp, "colorramp", type="gradient", name="[source]")
    options = ET.SubElement(source, "Option", type="Map")
    steps, values = (np.linspace(*ends, len(VIRIDIS)).tolist() for ends in ((0, 1), (low, high)))
    stops = [f"{step:g};{_rgba(c)}" for step, c in zip(steps, VIRIDIS, strict=True)]
    for name, value in {
        "color1": _rgba(VIRIDIS[0]),
        "color2": _rgba(VIRIDIS[-1]),
        "discrete": "0",
        "rampType": "gradient",
        "stops": ":".join(stops[1:-1]),
    }.items():
        ET.SubElement(options, "Option", name=name, type="QString", value=value)
    for value, (red, green, blue) in zip(values, VIRIDIS, strict=True):
        ET.SubElement(
            ramp,
            "item",
            value=repr(value),
            color=f"#{red:02x}{green:02x}{blue:02x}",
            label=f"{value:.{_decimals(low, high)}f}",
            alpha="255",
        )
    # A continuous legend would label the two ends only.
    ET.SubElement(ramp, "rampLegendSettings", useContinuousLegend="0", direction="0")
    return shader


def _limits(values: np.ndarray) -> tuple[float, float]:
    """Return the least and the largest finite value, 1 apart if there is only one, or none."""
    finite = values[np.isfinite(values)].astype(float)
    if not finite.size:
        return 0.0, 1.0
    low, high = float(finite.min()), float(finite.max())
    return (low, high) if low < high else (low - 0.5, high + 0.5)


def _decimals(low: float, high: float) -> int:
    """Number of decimals with which the labels of neighbouring stops differ."""
    return max(0, 2 - math.floor(math.log10(high - low)))


def _rgba(color: tuple[int, int, int]) -> str:
    return ",".join(map(str, (*color, 255)))
