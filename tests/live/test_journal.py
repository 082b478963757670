"""The journal: what was written is read back, and a torn or damaged file is named."""

import os

import numpy as np
import pytest

from trustbo.errors import DamagedFileError, TrustboError
from trustbo.live.journal import Journal


def test_lines_are_in_the_file_at_once_and_are_read_back(tmp_path):
    file = tmp_path / "live" / "0001.jsonl"
    journal = Journal(file)
    journal.write({"event": "plan", "path": np.array([[0, 1]])})
    journal.write({"n": 2})
    assert file.read_text() == '{"event": "plan", "path": [[0, 1]]}\n{"n": 2}\n'
    assert (journal.written, journal.synced) == (2, 0)
    journal.sync()
    assert journal.synced == 2
    journal.close()
    journal.close()
    assert Journal(file).records == [{"event": "plan", "path": [[0, 1]]}, {"n": 2}]


def test_a_torn_last_line_is_removed_before_the_next_one(tmp_path):
    file = tmp_path / "0001.jsonl"
    file.write_bytes(b'{"n": 1}\n{"n": 2')
    journal = Journal(file)
    assert journal.records == [{"n": 1}]
    journal.write({"n": 3})
    journal.close()
    assert file.read_text() == '{"n": 1}\n{"n": 3}\n'


@pytest.mark.parametrize("line", [b"\x00\x00", b"[1]", b'{"n": ', b"[" * 100_000])
def test_a_damaged_line_is_named_with_the_remedy(tmp_path, line):
    file = tmp_path / "0001.jsonl"
    file.write_bytes(b'{"n": 1}\n' + line + b"\n")
    with pytest.raises(DamagedFileError, match=r"line 2 is no JSON object.*move the file away"):
        Journal(file)


def test_a_full_disk_is_an_error_and_leaves_no_half_of_a_line(tmp_path):
    journal = Journal(tmp_path / "0001.jsonl")
    journal.write({"n": 1})
    kept, journal._file = journal._file, os.open("/dev/full", os.O_WRONLY)
    with pytest.raises(TrustboError, match="the disk is full"):
        journal.write({"n": 2})
    journal._file = kept
    journal.write({"n": 3})
    assert journal.path.read_text() == '{"n": 1}\n{"n": 3}\n'


def test_a_folder_that_may_not_be_written_to_is_named(tmp_path):
    (tmp_path / "live").write_text("a file")
    with pytest.raises(TrustboError, match="live' is a file"):
        Journal(tmp_path / "live" / "0001.jsonl")
