"""The terrain that comes with the package."""

import hashlib
from pathlib import Path

import numpy as np

import trustbo as tb
from trustbo.terrain.examples import EXAMPLE_FILES


def test_the_example_is_ground_and_canopy_with_its_owner():
    terrain = tb.terrain.example()
    assert terrain.rio.crs.to_epsg() == 2193
    height = (terrain["dsm"] - terrain["dem"]).values
    assert 40.0 < np.nanmax(height) < 50.0  # bush, as LICENCE.md says
    assert 205.0 < float(terrain["dem"].max() - terrain["dem"].min()) < 215.0
    assert "CC BY 4.0" in terrain.attrs["attribution"]
    folder = Path(EXAMPLE_FILES[0]).parent
    assert terrain.attrs["attribution"] in " ".join((folder / "LICENCE.md").read_text().split())
    assert sum(file.stat().st_size for file in folder.iterdir()) < 1e6


def test_the_example_s_files_are_those_whose_origin_is_stated(real_data):
    for file in map(Path, EXAMPLE_FILES):
        digest = hashlib.sha256(file.read_bytes()).hexdigest()
        assert f"{digest}  wellington/{file.name}" in (real_data / "SHA256SUMS").read_text()
