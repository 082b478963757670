"""Files are written whole or not at all."""

import pytest

from trustbo.errors import TrustboError
from trustbo.files import read_record, require_suffix, write_file


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


@pytest.mark.parametrize("content", [b"", b"{", b"[1]", b"\xff", b"[" * 100000])
def test_damaged_record_is_named(tmp_path, content):
    with pytest.raises(TrustboError, match="cannot be read"):
        read_record(tmp_path / "a.json")
    (tmp_path / "a.json").write_bytes(content)
    with pytest.raises(TrustboError, match=r"a\.json"):
        read_record(tmp_path / "a.json")


def test_files_are_written_with_the_suffix_of_their_format(tmp_path):
    assert require_suffix(tmp_path / "a.CSV", ".csv").name == "a.CSV"
    with pytest.raises(TrustboError, match=r"a\.png"):
        require_suffix(tmp_path / "a.png", ".csv")
