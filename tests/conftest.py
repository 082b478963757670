"""Settings of every test, and fixtures that several rooms share."""

import shutil
from pathlib import Path

import jax
import matplotlib as mpl
import pytest
from matplotlib.figure import Figure

mpl.use("Agg")
jax.config.update("jax_numpy_rank_promotion", "raise")

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def leave_figures_blank():
    """Save figures without what they show, and draw none in a report, which takes seconds."""
    from trustbo.report.blocks import Picture  # 3 s, of no use where workers run tests

    def picture(_, alt, caption):
        return Picture(alt, caption, "data:image/svg+xml;base64,PHN2Zy8+", 800, 400)

    def leave(monkeypatch):
        monkeypatch.setattr(Figure, "draw", lambda *_: None)
        monkeypatch.setattr("trustbo.report.figures.picture", picture)

    return leave


@pytest.fixture
def blank_figures(monkeypatch, leave_figures_blank):
    """The same for one test."""
    leave_figures_blank(monkeypatch)


@pytest.fixture(scope="session")
def chromium():
    """A headless browser that selenium drives; skips where there is none."""
    program, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if program is None or driver is None:
        pytest.skip("no chromium and chromedriver on the path")
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = program
    for flag in ("--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    browser = webdriver.Chrome(options=options, service=Service(driver))
    yield browser
    browser.quit()


@pytest.fixture
def real_terrain():
    """Paths of a real DEM and DSM by name; skips where the shared data are absent."""

    def paths(name):
        if not DATA.exists():
            pytest.skip(f"no shared data at {DATA}")
        return DATA / name / "dem.tif", DATA / name / "dsm.tif"

    return paths
