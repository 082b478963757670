"""Files are whole or not there, whatever interrupts their writing."""

import os
import shutil
import signal
import subprocess
import sys
import threading

import pytest

from trustbo.errors import DamagedFileError, TrustboError
from trustbo.files import (
    read_record,
    read_yaml,
    remove_leftovers,
    require_file,
    require_folder,
    write_file,
    write_text,
)


@pytest.fixture(autouse=True)
def _ctrl_c_raises():
    """Shells start background jobs with SIGINT ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    signal.signal(signal.SIGINT, before)


def writes(presses, number=signal.SIGINT):
    """Of two halves, with Ctrl-C so many times in between."""

    def write(file):
        file.write_text("half")
        for _ in range(presses):
            signal.raise_signal(number)
        file.write_text("whole")

    return write


def test_ctrl_c_waits_for_a_file_to_be_whole(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        write_file(tmp_path / "a.txt", writes(1))
    assert [file.read_text() for file in tmp_path.iterdir()] == ["whole"]


def test_a_second_ctrl_c_leaves_what_was_there(tmp_path):
    write_file(tmp_path / "a.txt", lambda file: file.write_text("before"))
    with pytest.raises(KeyboardInterrupt):
        write_file(tmp_path / "a.txt", writes(2))
    assert [file.read_text() for file in tmp_path.iterdir()] == ["before"]


def test_ctrl_c_is_not_lost_when_a_write_fails(tmp_path):
    def fail(file):
        signal.raise_signal(signal.SIGINT)
        raise OSError("the disk is full")

    with pytest.raises(KeyboardInterrupt):
        write_file(tmp_path / "a.txt", fail)
    assert list(tmp_path.iterdir()) == []


def test_files_are_written_in_threads_too(tmp_path):
    thread = threading.Thread(target=write_file, args=(tmp_path / "a.txt", writes(0)))
    thread.start()
    thread.join()
    assert (tmp_path / "a.txt").read_text() == "whole"


def test_sigterm_waits_too(tmp_path):
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            write_file(tmp_path / "a.txt", writes(1, signal.SIGTERM))
    finally:
        signal.signal(signal.SIGTERM, before)
    assert (tmp_path / "a.txt").read_text() == "whole"


def test_a_full_disk_is_said_to_be_full(tmp_path):
    """In a process whose files may have 10 kB: the largest real limit that needs no other disk."""
    program = (
        "import resource, signal; signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, 10_000))\n"
        "from trustbo.files import write_text\n"
        "write_text('a.txt', 'x' * 1000)\n"
        "write_text('a.txt', 'x' * 100_000)\n"
    )
    done = subprocess.run(
        [sys.executable, "-B", "-c", program], cwd=tmp_path, capture_output=True, text=True,
    )  # fmt: skip
    assert "TrustboError: the disk is full: 'a.txt' was not written" in done.stderr
    assert (tmp_path / "a.txt").read_text() == "x" * 1000  # as it was


@pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="a folder that even root cannot write")
def test_a_folder_that_may_not_be_written_to_is_named():
    for file in ("/proc/a.txt", "/proc/none/a.txt"):
        with pytest.raises(TrustboError, match=r"cannot write to '/proc.*; give a folder that may"):
            write_text(file, "")


def test_another_file_that_is_missing_is_no_folder_that_refuses(tmp_path):
    with pytest.raises(FileNotFoundError):
        write_file(tmp_path / "a.txt", lambda file: shutil.copyfile(tmp_path / "none", file))


@pytest.mark.parametrize("require", [require_file, require_folder])
def test_what_is_no_path_is_named(require):
    """Arguments in the wrong order, say."""
    with pytest.raises(TrustboError, match="give the path of a file or folder; got a dict"):
        require({})


@pytest.mark.parametrize("nested", ["[" * 5000, "- " * 5000 + "1", "{a: " * 5000])
def test_yaml_that_is_nested_too_deeply_is_refused(tmp_path, nested):
    (tmp_path / "deep.yaml").write_text(nested)
    with pytest.raises(TrustboError, match=r"deep.yaml' is no YAML: "):
        read_yaml(tmp_path / "deep.yaml")


def test_only_what_has_our_mark_is_a_leftover(tmp_path):
    """In the folder itself, and through no link."""
    (tmp_path / "elsewhere").mkdir()
    kept = [
        tmp_path / name
        for name in (".notes.2024.csv", ".bashrc.1", ".x.12", "elsewhere/.a.trustbo-12.nc")
    ]
    for file in kept:
        file.write_text("mine")
    linked = tmp_path / ".b.trustbo-12.nc"
    linked.symlink_to(kept[0])
    left = [tmp_path / ".a.trustbo-123.nc", tmp_path / "..a.nc.trustbo-123.sha256"]
    for file in left:
        file.write_text("half")
    remove_leftovers(tmp_path)
    (tmp_path / "linked").symlink_to("elsewhere")
    remove_leftovers(tmp_path / "linked")
    assert [file.exists() for file in [*kept, linked, *left]] == [True] * 5 + [False] * 2


def test_a_file_is_not_written_through_a_link(tmp_path):
    precious = tmp_path / "precious.txt"
    precious.write_text("mine")
    for name in ("a.txt", f".a.trustbo-{os.getpid()}.txt"):
        (tmp_path / name).symlink_to(precious)
    write_file(tmp_path / "a.txt", lambda file: file.write_text("ours"))
    assert precious.read_text() == "mine"
    assert (tmp_path / "a.txt").read_text() == "ours"
    assert not (tmp_path / "a.txt").is_symlink()


@pytest.mark.parametrize("content", ['{"seed": ', "3", "[" * 100_000])
def test_a_record_that_is_none_is_named(tmp_path, content):
    file = tmp_path / "result.json"
    file.write_text(content)
    with pytest.raises(DamagedFileError, match=r"result\.json' is damaged: no "):
        read_record(file)
    with pytest.raises(DamagedFileError, match="is missing"):
        read_record(tmp_path / "campaign.json")
    (tmp_path / "campaign.json").mkdir()
    with pytest.raises(DamagedFileError, match="cannot be read"):
        read_record(tmp_path / "campaign.json")
