"""A campaign in a folder, copied for each test."""

import shutil

import pytest
from worlds import begin, random_cells


@pytest.fixture(scope="session")
def learned(tmp_path_factory):
    """The folder of a campaign with one mission of three robots on 4 x 4 cells."""
    folder = tmp_path_factory.mktemp("learned") / "campaign"
    begin(random_cells(), folder, 1)
    return folder


@pytest.fixture
def folder(learned, tmp_path):
    """A copy of it, free to be changed."""
    return shutil.copytree(learned, tmp_path / "campaign")
