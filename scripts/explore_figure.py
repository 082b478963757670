"""Photograph the page of `result.explore()`, for docs/figures/explore.png, light and dark.

A bound of the last mission is pointed at, for its numbers to be seen. Chromium, its driver and
selenium are needed.
"""

import base64
import shutil
import tempfile
import time
from pathlib import Path

from selenium import webdriver
from selenium.webdriver.common.by import By

import trustbo as tb

FIGURES = Path(__file__).resolve().parents[1] / "docs" / "figures"
SIZE = {"width": 1300, "height": 860}


def main() -> None:
    """Run the campaign of docs/gallery.md, and photograph its page in both themes."""
    workspace = tb.Workspace.from_terrain(tb.terrain.example("wellington"), shape=(10, 10))
    result = tb.iterate(workspace, start=(9, 0), goal=(0, 9), n_iterations=8, progress=False)
    with tempfile.TemporaryDirectory() as folder:
        page = Path(folder) / "explore.html"
        result.explore().save(page)
        for theme, target in (("light", FIGURES), ("dark", FIGURES / "dark")):
            (target / "explore.png").write_bytes(photograph(page.as_uri(), theme))


def photograph(address: str, theme: str) -> bytes:
    """PNG of the page in a theme of the browser, with the last mission, and a bound of it."""
    options = webdriver.ChromeOptions()
    for flag in ("--headless=new", "--no-sandbox", "--hide-scrollbars"):
        options.add_argument(flag)
    driver = webdriver.ChromeService(shutil.which("chromedriver"))  # selenium would seek one online
    with webdriver.Chrome(options, driver) as browser:
        emulate = browser.execute_cdp_cmd
        screen = {**SIZE, "deviceScaleFactor": 1, "mobile": False}
        emulate("Emulation.setDeviceMetricsOverride", screen)
        features = [{"name": "prefers-color-scheme", "value": theme}]
        emulate("Emulation.setEmulatedMedia", {"features": features})
        browser.get(address)
        time.sleep(3.0)  # Bokeh draws
        browser.execute_script(
            "const step = document.getElementById('step'); step.value = step.max - 1;"
            "step.dispatchEvent(new Event('input'))"
        )
        chart = browser.find_element(By.ID, "chart").rect
        x, y = chart["x"] + 0.5 * chart["width"], chart["y"] + 0.5 * chart["height"]
        emulate("Input.dispatchMouseEvent", {"type": "mouseMoved", "x": x, "y": y})
        time.sleep(1.0)
        return base64.b64decode(emulate("Page.captureScreenshot", {})["data"])


if __name__ == "__main__":
    main()
