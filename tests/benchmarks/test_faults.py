"""Planted faults: each can be planted, once, in the source as it is."""

from pathlib import Path

import pytest
from faults import FAULTS, NEIGHBOURS, place_of

TESTS = Path(__file__).resolve().parents[1]


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_the_text_of_a_fault_is_in_the_source_exactly_once(fault):
    file = place_of(fault)
    assert file is not None
    planted = file.read_text().replace(fault.before, fault.after)
    assert planted != file.read_text()
    compile(planted, file, "exec")


@pytest.mark.parametrize("file", ["a.py", "moved.py"])
def test_a_fault_is_found_where_its_file_moved_and_not_where_its_text_is_twice(tmp_path, file):
    fault, source = FAULTS[0]._replace(file="a.py"), tmp_path / "src" / "trustbo"
    source.mkdir(parents=True)
    (source / file).write_text(fault.before)
    assert place_of(fault, tmp_path) == source / file
    (source / file).write_text(2 * fault.before)
    assert place_of(fault, tmp_path) is None


def test_every_fault_has_a_name_of_its_own_and_a_room_with_tests():
    assert len({fault.name for fault in FAULTS}) == len(FAULTS) == 28
    rooms = {fault.file.split("/")[0] for fault in FAULTS}
    assert [name for name in rooms if name not in NEIGHBOURS or not (TESTS / name).is_dir()] == []
