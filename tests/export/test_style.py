"""Styles, by what QGIS reads in them."""

import xml.etree.ElementTree as ET

import matplotlib as mpl
import numpy as np
import pytest
import xarray as xr

from trustbo.errors import ShapeError, TrustboError
from trustbo.export import write_geotiff
from trustbo.export.style import write_style


def read(path):
    """The renderer, its shader, and the stops as value, colour, label."""
    text = path.read_text(encoding="utf-8")
    assert text.startswith("<!DOCTYPE qgis PUBLIC")
    root = ET.fromstring(text)
    assert root.tag == "qgis"
    assert root.get("version").startswith("3.")
    renderer = root.find("pipe/rasterrenderer")
    shader = renderer.find("rastershader/colorrampshader")
    stops = [(float(i.get("value")), i.get("color"), i.get("label")) for i in shader.iter("item")]
    return renderer, shader, stops


def test_the_first_band_has_viridis_from_its_least_to_its_largest_value(result, maps, tmp_path):
    write_geotiff(tmp_path / "maps.tif", maps, result.workspace)
    renderer, shader, stops = read(tmp_path / "maps.qml")
    assert renderer.get("type") == "singlebandpseudocolor"
    assert renderer.get("band") == "1"
    assert renderer.find("minMaxOrigin/limits").text == "None"
    assert shader.get("colorRampType") == "INTERPOLATED"
    low, high = float(maps["trust_mean"].min()), float(maps["trust_mean"].max())
    for element, names in (
        (renderer, ("classificationMin", "classificationMax")),
        (shader, ("minimumValue", "maximumValue")),
    ):
        assert [float(element.get(name)) for name in names] == [low, high]
    np.testing.assert_allclose([value for value, *_ in stops], np.linspace(low, high, 11))
    assert (stops[0][0], stops[-1][0]) == (low, high)


def test_between_the_stops_the_colours_are_those_of_matplotlib(result, maps, tmp_path):
    write_style(tmp_path / "maps.qml", maps)
    _, shader, stops = read(tmp_path / "maps.qml")
    colors = np.array([[int(c[i : i + 2], 16) for i in (1, 3, 5)] for _, c, _ in stops])
    fine = np.linspace(0.0, 1.0, 256)
    ours = np.stack([np.interp(fine, np.linspace(0.0, 1.0, 11), c) for c in colors.T], axis=1)
    theirs = 255.0 * mpl.colormaps["viridis"](fine)[:, :3]
    np.testing.assert_allclose(ours, theirs, rtol=0.0, atol=14.0)
    # The ramp that QGIS shows for editing is made of the same.
    ramp = {o.get("name"): o.get("value") for o in shader.findall("colorramp/Option/Option")}
    inner = [stop.split(";") for stop in ramp["stops"].split(":")]
    said = [ramp["color1"], *(color for _, color in inner), ramp["color2"]]
    assert said == [",".join(map(str, (*color, 255))) for color in colors]
    np.testing.assert_allclose([float(at) for at, _ in inner], np.linspace(0.0, 1.0, 11)[1:-1])


@pytest.mark.parametrize(
    ("low", "high", "labels"),
    [
        (0.0, 1.0, [f"{i / 10:.2f}" for i in range(11)]),
        (-500.0, 500.0, [str(100 * i) for i in range(-5, 6)]),
        (0.7, 0.704, [f"{0.7 + 0.0004 * i:.5f}" for i in range(11)]),
        (2.0, 2.0, [f"{1.5 + i / 10:.2f}" for i in range(11)]),
        (np.nan, np.nan, [f"{i / 10:.2f}" for i in range(11)]),
    ],
)
def test_labels_have_as_many_digits_as_tell_them_apart(low, high, labels, tmp_path):
    values = xr.DataArray([[low, high, np.nan]], dims=("row", "col"))
    write_style(tmp_path / "map.qml", values)
    assert [label for *_, label in read(tmp_path / "map.qml")[2]] == labels


def test_no_maps_and_other_suffixes_are_refused(maps, tmp_path):
    with pytest.raises(ShapeError, match="there are no maps"):
        write_style(tmp_path / "other.qml", xr.Dataset())
    with pytest.raises(TrustboError, match=r"other\.xml' must end in \.qml"):
        write_style(tmp_path / "other.xml", maps)
    assert not list(tmp_path.iterdir())
