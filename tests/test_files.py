"""Files are whole or not there, whatever interrupts their writing."""

import os
import shutil
import signal
import subprocess
import sys
import threading

import netCDF4
import pytest

import trustbo.files
from trustbo.campaign.damage import read_fields
from trustbo.errors import DamagedFileError, TrustboError
from trustbo.files import (
    read_checked,
    read_yaml,
    remove_checked,
    remove_leftovers,
    require_file,
    require_folder,
    write_checked,
    write_file,
)
from trustbo.logs import read_missions
from trustbo.logs.netcdf import read_tree


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
        "from trustbo.files import write_checked\n"
        "write_checked('a.bin', b'x' * 1000)\n"
        "write_checked('a.bin', b'x' * 100_000)\n"
    )
    done = subprocess.run(
        [sys.executable, "-B", "-c", program], cwd=tmp_path, capture_output=True, text=True,
    )  # fmt: skip
    assert "TrustboError: the disk is full: 'a.bin' was not written" in done.stderr
    assert read_checked(tmp_path / "a.bin") == b"x" * 1000  # as it was, and known to be whole


class DiedError(Exception):
    """The process ends here."""


def test_whenever_it_dies_a_file_and_its_sum_agree(tmp_path, monkeypatch):
    """Twice in a row between the sum and the file, too."""
    file, replace = tmp_path / "a.bin", os.replace

    def dies_at(n):
        count = [0]

        def counted(*names):
            count[0] += 1
            if count[0] == n:
                raise DiedError
            replace(*names)

        return counted

    write_checked(file, b"0")
    for j, n in enumerate([2, 2, 1, 2, 3, 1, 2], start=1):
        with monkeypatch.context() as patch:
            patch.setattr(trustbo.files.os, "replace", dies_at(n))
            try:
                write_checked(file, str(j).encode())
            except DiedError:
                assert n < 3
        assert read_checked(file) == (b"5" if j >= 5 else b"0")
    file.write_bytes(b"noise")
    with pytest.raises(DamagedFileError, match=r"a.bin' is damaged: its bytes are not those"):
        read_checked(file)


@pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="a folder that even root cannot write")
def test_a_folder_that_may_not_be_written_to_is_named():
    for file in ("/proc/a.txt", "/proc/none/a.txt"):
        with pytest.raises(TrustboError, match=r"cannot write to '/proc.*; give a folder that may"):
            write_checked(file, b"")


def test_another_file_that_is_missing_is_no_folder_that_refuses(tmp_path):
    with pytest.raises(FileNotFoundError):
        write_file(tmp_path / "a.txt", lambda file: shutil.copyfile(tmp_path / "none", file))


@pytest.mark.parametrize("require", [require_file, require_folder])
def test_what_is_no_path_is_named(require):
    """Arguments in the wrong order, say."""
    with pytest.raises(TrustboError, match="give the path of a file or folder; got a dict"):
        require({})


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ('{"seed": ', "is damaged: no JSON"),
        ("3", "is damaged: no record of fields"),
        ('{"path": []}', "is damaged: it lacks n_missions, trust, value, settings"),
        ("[" * 100_000, "is damaged: no JSON .maximum recursion depth"),
    ],
)
def test_a_record_that_is_none_is_named(tmp_path, content, message):
    file = tmp_path / "result.json"
    file.write_text(content)
    with pytest.raises(DamagedFileError, match=message):
        read_fields(file)
    with pytest.raises(DamagedFileError, match="is missing"):
        read_fields(tmp_path / "campaign.json")
    (tmp_path / "campaign.json").mkdir()
    with pytest.raises(DamagedFileError, match="cannot be read: it is a folder"):
        read_fields(tmp_path / "campaign.json")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="a system without pipes")
@pytest.mark.parametrize("read", [read_checked, read_tree, read_yaml, read_missions])
def test_a_pipe_a_device_or_a_sea_of_zeros_is_refused_at_once(tmp_path, read):
    pipe, zeros, vast = (tmp_path / f"{name}.csv" for name in ("pipe", "zeros", "vast"))
    os.mkfifo(pipe)
    zeros.symlink_to("/dev/zero")
    with vast.open("wb") as stream:
        stream.truncate(1 << 40)
    for file in (pipe, zeros):
        with pytest.raises(TrustboError, match=rf"{file.name}' cannot be read: it is a pipe or a"):
            read(file)
    with pytest.raises(TrustboError, match=r"vast.csv' cannot be read: it has 1099511627776 bytes"):
        read(vast)


def test_a_small_file_that_unpacks_to_much_is_refused(tmp_path):
    file = tmp_path / "bomb.nc"
    with netCDF4.Dataset(file, "w") as data:
        group = data.createGroup("missions")
        group.createDimension("mission", 1 << 32)
        group.createVariable("status", "f8", ("mission",), zlib=True)
    assert file.stat().st_size < 100_000
    with pytest.raises(DamagedFileError, match=r"bomb.nc' is too large for memory .* to 34359738"):
        read_tree(file)


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


def test_a_file_without_a_sum_is_not_removed(tmp_path):
    write_checked(tmp_path / "ours.nc", b"")
    (tmp_path / "theirs.nc").write_bytes(b"")
    for name in ("ours.nc", "theirs.nc"):
        remove_checked(tmp_path / name)
    assert [file.name for file in tmp_path.iterdir()] == ["theirs.nc"]
