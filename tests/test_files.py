"""Files are written whole or not at all."""

import pytest

from trustbo.errors import TrustboError
from trustbo.files import read_file, write_file


def test_failed_write_leaves_the_file_before(tmp_path):
    def fail(file):
        file.write_text("half")
        raise RuntimeError

    write_file(tmp_path / "new" / "a.txt", lambda file: file.write_text("before"))
    with pytest.raises(RuntimeError):
        write_file(tmp_path / "new" / "a.txt", fail)
    assert (tmp_path / "new" / "a.txt").read_text() == "before"
    write_file(tmp_path / "new" / "a.txt", lambda file: file.write_text("after"))
    assert [file.read_text() for file in (tmp_path / "new").iterdir()] == ["after"]


def test_refusal_of_the_system_names_the_file(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(TrustboError, match=r"a\.txt"):
        write_file(tmp_path / "file" / "a.txt", lambda file: file.write_text("text"))


def test_missing_file_is_named(tmp_path):
    with pytest.raises(TrustboError, match=r"a\.json.* cannot be read"):
        read_file(tmp_path / "a.json")
