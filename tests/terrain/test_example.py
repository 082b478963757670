"""The terrain that comes with the package."""

import hashlib
from pathlib import Path

import numpy as np
import pytest

import trustbo as tb
from trustbo.terrain.example import EXAMPLES, example_files


@pytest.mark.parametrize("name", EXAMPLES)
def test_an_example_is_ground_and_canopy_with_its_owner(name):
    terrain = tb.terrain.example(name)
    assert terrain.rio.crs.to_epsg() == 2193
    height = (terrain["dsm"] - terrain["dem"]).values
    assert 40.0 < np.nanmax(height) < 50.0  # bush, as LICENCE.md says
    assert 205.0 < float(terrain["dem"].max() - terrain["dem"].min()) < 215.0
    assert "CC BY 4.0" in terrain.attrs["attribution"]
    folder = Path(example_files(name)[0]).parent
    assert terrain.attrs["attribution"] in " ".join((folder / "LICENCE.md").read_text().split())
    assert sum(file.stat().st_size for file in folder.iterdir()) < 1e6


def test_an_example_s_files_are_those_whose_origin_is_stated(real_data):
    for file in map(Path, example_files("wellington")):
        digest = hashlib.sha256(file.read_bytes()).hexdigest()
        assert f"{digest}  wellington/{file.name}" in (real_data / "SHA256SUMS").read_text()


def test_an_example_that_there_is_not_is_named():
    with pytest.raises(tb.TrustboError, match="unknown example 'tahoe'; choose one of well"):
        tb.terrain.example("tahoe")
