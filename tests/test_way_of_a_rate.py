"""The way of a contact rate through the code is that of the table in CONTRIBUTING.md."""

import re
import sys
import threading
from pathlib import Path
from types import FrameType

import numpy as np

import trustbo as tb

ROOT = Path(__file__).parents[1]
PACKAGE = Path(tb.__file__).parent
STATION = re.compile(r"^\| (\d+) \| `([\w/]+\.py)` \| `([\w.]+)` \| .+ \|$", re.MULTILINE)


def followed(action):
    """Call a function, and return the functions of the package that it enters, in order."""
    entered: dict[tuple[str, str], int] = {}

    def note(frame: FrameType, event: str, _: object) -> None:
        code = frame.f_code
        file = Path(code.co_filename)
        if event == "call" and file.is_relative_to(PACKAGE):
            place = file.relative_to(PACKAGE).as_posix(), code.co_qualname
            entered.setdefault(place, len(entered))

    threading.setprofile_all_threads(note)
    try:
        action()
    finally:
        threading.setprofile_all_threads(None)
        sys.setprofile(None)
    return entered


def test_a_rate_takes_the_way_that_is_described(tmp_path):
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    section = text.split("### The way of a contact rate")[1].split("\n## ")[0]
    stations = STATION.findall(section)
    assert [int(number) for number, _, _ in stations] == list(range(1, 21))

    rng = np.random.default_rng(0)
    workspace = tb.Workspace.from_awareness(rng.uniform(size=(2, 3, 3, 2)))

    def tell(campaign: tb.Campaign, path: tuple[tb.data.Station, ...]) -> None:
        n_bounds = len(path) - 1
        unmeasured = np.full((n_bounds, 2, 2), np.nan)
        rates = rng.uniform(0.4, 0.8, (n_bounds, 2))

        campaign.tell(tb.Mission.from_arrays(path, unmeasured, rates))
        assert campaign.posterior["latent"]["trust"].notnull().any()

    first, second = (
        tb.Campaign(workspace, (2, 0), (0, 2), directory=tmp_path / name) for name in "ab"
    )
    tell(first, first.ask().path)  # compiles kernels, which takes long if calls are noted
    path = second.ask().path
    entered = followed(lambda: tell(second, path))
    places = [(file, function) for _, file, function in stations]
    assert [place for place in places if place not in entered] == []
    numbers = [entered[place] for place in places]
    assert numbers == sorted(numbers)
