"""Files are whole or not there, whatever interrupts their writing."""

import signal
import threading

import pytest

from trustbo.files import write_file


@pytest.fixture(autouse=True)
def _ctrl_c_raises():
    """Shells start background jobs with SIGINT ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    signal.signal(signal.SIGINT, before)


def writes(presses):
    """Of two halves, with Ctrl-C so many times in between."""

    def write(file):
        file.write_text("half")
        for _ in range(presses):
            signal.raise_signal(signal.SIGINT)
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
