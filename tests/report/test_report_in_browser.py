"""The report page in a real browser, at the widths of a desk and of a phone."""

import io

import numpy as np
import pytest
from PIL import Image

import trustbo as tb
from trustbo.report import write_report

WIDTHS = {"wide": (1280, 900, False), "phone": (390, 844, True)}


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """A report with long names and a table wider than a phone."""
    team = tb.Team(names=("the-first-robot", "the-second-robot"), n_robots=2)
    awareness = np.random.default_rng(0).uniform(size=(2, 4, 4, 2))
    workspace = tb.Workspace.from_awareness(awareness, team=team)
    truth = tb.models.TrustParams(0.4, np.array([0.5, 0.2]), 0.1, 0.05, 0.05)
    result = tb.iterate(
        workspace,
        (3, 0),
        (0, 3),
        n_iterations=4,
        sampler="exact",
        simulator=tb.simulation.ModelSimulator(workspace, truth),
        progress=False,
    )
    path = tmp_path_factory.mktemp("report") / "report.html"
    write_report(path, result)
    return path.as_uri()


@pytest.fixture(params=WIDTHS.values(), ids=list(WIDTHS))
def seen(request, chromium, page):
    """The page as it is seen at a width."""
    width, height, mobile = request.param
    metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": mobile}
    chromium.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    chromium.get(page)
    return chromium


def test_everything_is_shown_without_complaint(seen):
    assert seen.get_log("browser") == []
    loaded = seen.execute_script(
        "return [...document.images].map(i => i.complete && i.naturalWidth > 0)"
    )
    assert loaded == [True] * 9


def test_the_page_may_fetch_nothing(seen):
    refused = seen.execute_async_script(
        """
        const done = arguments[arguments.length - 1];
        document.addEventListener('securitypolicyviolation', e => done(e.blockedURI));
        setTimeout(() => done('loaded'), 5000);
        new Image().src = 'http://127.0.0.1:9/pixel.png';
        """
    )
    assert refused == "http://127.0.0.1:9/pixel.png"
    assert seen.get_log("browser") != []  # read, so that the next test sees its own


def test_nothing_overflows_the_page_and_text_can_be_read(seen):
    assert seen.execute_script("return document.scrollingElement.scrollWidth <= window.innerWidth")
    sizes = seen.execute_script(
        "return [...document.querySelectorAll('p, dd, dt, li, td, th, caption, figcaption')]"
        ".map(e => parseFloat(getComputedStyle(e).fontSize))"
    )
    assert min(sizes) >= 14.0
    outside = seen.execute_script(
        "return [...document.querySelectorAll('p, dl, h1, h2, nav, figure, .scroll')]"
        ".filter(e => e.getBoundingClientRect().right > window.innerWidth + 0.5)"
        ".map(e => e.outerHTML.slice(0, 80))"
    )
    assert outside == []


def test_text_in_figures_can_be_read_as_wide_ones_scroll(seen):
    """Text of 7 points, the smallest in figures, is 9.3 pixels high unless they are shrunk."""
    scales = seen.execute_script(
        "return [...document.images].map(i => i.getBoundingClientRect().width / i.naturalWidth)"
    )
    assert min(scales) * 7 * 96 / 72 >= 9.0
    if seen.execute_script("return window.innerWidth") > 1000:
        hidden = seen.execute_script(
            "return [...document.querySelectorAll('figure .scroll')]"
            ".map(e => e.scrollWidth - e.clientWidth)"
        )
        assert max(hidden) == 0


def test_wide_tables_scroll_on_their_own(seen):
    overflow = seen.execute_script(
        "return [...document.querySelectorAll('.scroll')].map(e => getComputedStyle(e).overflowX)"
    )
    assert set(overflow) == {"auto"}


def test_text_stands_out_and_so_do_figures(chromium, page):
    chromium.get(page)

    def style(selector, name):
        return chromium.execute_script(
            "return getComputedStyle(document.querySelector(arguments[0]))[arguments[1]]",
            selector,
            name,
        )

    ground = luminance(style("body", "backgroundColor"))
    for selector in ("body", "a", "figcaption", "caption", ".kind", ".good", "footer"):
        text = luminance(style(selector, "color"))
        high, low = max(text, ground) + 0.05, min(text, ground) + 0.05
        assert high / low >= 4.5, selector  # WCAG 2, level AA
    picture = chromium.find_element("css selector", "figure img")
    with Image.open(io.BytesIO(picture.screenshot_as_png)) as image:
        corner = image.convert("RGB").getpixel((4, 4))
        values = np.asarray(image.convert("L"), dtype=float)
    assert abs(luminance(f"rgb{corner}") - ground) < 0.01  # no box around a figure
    assert (np.abs(values - values[4, 4]) > 150.0).any()  # text and frames stand out


def luminance(colour):
    """Relative luminance of a CSS colour such as "rgb(1, 2, 3)"."""
    channels = [int(c) / 255 for c in colour[colour.index("(") + 1 : -1].split(",")[:3]]
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in channels]
    return float(np.dot(linear, (0.2126, 0.7152, 0.0722)))
