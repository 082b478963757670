"""Files are written whole or not at all."""

import os
import signal
import threading

import pytest

from trustbo.errors import TrustboError
from trustbo.files import hash_of, holding_interrupts, read_file, write_file


def test_failed_write_leaves_the_file_before(tmp_path, monkeypatch):
    def fail(descriptor):
        raise RuntimeError

    write_file(tmp_path / "new" / "a.txt", b"before")
    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", fail)
        with pytest.raises(RuntimeError):
            write_file(tmp_path / "new" / "a.txt", b"half")
    assert (tmp_path / "new" / "a.txt").read_text() == "before"
    write_file(tmp_path / "new" / "a.txt", b"after")
    assert [file.read_text() for file in (tmp_path / "new").iterdir()] == ["after"]


def test_refusal_of_the_system_names_the_file(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(TrustboError, match=r"a\.txt"):
        write_file(tmp_path / "file" / "a.txt", b"text")


def test_missing_file_is_named(tmp_path):
    with pytest.raises(TrustboError, match=r"a\.json.* cannot be read"):
        read_file(tmp_path / "a.json")


def test_two_threads_that_write_one_file_both_write_it_whole(tmp_path, monkeypatch):
    written, file, fsync = threading.Barrier(2), tmp_path / "a.txt", os.fsync

    def together(descriptor):
        written.wait(timeout=30)
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", together)

    def write(letter):
        write_file(file, letter.encode() * 2000)
        assert set(file.read_text()) <= {"a", "b"}

    threads = [threading.Thread(target=write, args=(letter,)) for letter in "ab"]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert file.read_text() in ("a" * 2000, "b" * 2000)
    assert list(tmp_path.iterdir()) == [file]


def test_link_is_followed_and_permissions_are_kept(tmp_path):
    target, link = tmp_path / "target.txt", tmp_path / "link.txt"
    target.write_text("before")
    target.chmod(0o600)
    link.symlink_to(target)
    write_file(link, b"after")
    assert link.is_symlink()
    assert target.read_text() == "after"
    assert target.stat().st_mode & 0o777 == 0o600


def test_home_folder_is_expanded(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    write_file("~/a.txt", b"text")
    assert read_file("~/a.txt") == (tmp_path / "a.txt").read_bytes() == b"text"


@pytest.mark.parametrize(
    "path", ["", "a\0b", 3, b"bytes", None, "a" * 300, "/dev/full", "\udcff\ud800"]
)
def test_path_that_no_file_can_have_is_refused(path):
    with pytest.raises(TrustboError):
        write_file(path, b"text")


def test_interrupt_is_held_back_until_the_block_ends():
    done = []

    def work():
        with holding_interrupts():
            signal.raise_signal(signal.SIGINT)
            done.append(True)

    with pytest.raises(KeyboardInterrupt):
        work()
    assert done
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)


def test_content_that_was_changed_is_refused(tmp_path):
    write_file(tmp_path / "a", b"text")
    assert read_file(tmp_path / "a", hash_of(b"text")) == b"text"
    with pytest.raises(TrustboError, match="damaged"):
        read_file(tmp_path / "a", hash_of(b"other"))
