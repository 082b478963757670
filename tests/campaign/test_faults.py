"""Every write, flush, rename and deletion of every operation fails once; nothing is lost.

After each fault, what was acknowledged is on disk, what was refused is not, the retry works, and
the campaign goes on as if nothing had happened.
"""

import errno
import functools
import itertools
import os
import re
import shutil
import signal
import subprocess
import tempfile
import warnings
from contextlib import contextmanager
from pathlib import Path

import pytest
from folders import begin, same
from worlds import ModelSimulator, random_cells

import trustbo as tb
from trustbo.files import TEMPORARY

FAULTS = {
    "full": lambda: OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)),
    "denied": lambda: OSError(errno.EACCES, os.strerror(errno.EACCES)),
    "broken": lambda: OSError(errno.EIO, os.strerror(errno.EIO)),
    "interrupt": None,
}
CALLS = ("open", "fdopen", "fsync", "replace", "rename", "mkdir", "unlink", "rmdir")
OTHER = [(2, 0), (1, 0), (0, 1), (0, 2)]
BACK = {"start": (0, 2), "goal": (2, 0), "robots": ("r1",)}
"""Another course, of one robot."""


class HalfWritten:
    """File that fails after it has written half of its first content."""

    def __init__(self, stream, fail):
        self._stream = stream
        self._fail = fail

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self._stream.__exit__(*error)

    def write(self, content):
        self._stream.write(content[: len(content) // 2])
        self._fail()
        self._stream.write(content[len(content) // 2 :])


class Failing:
    """Lets the n-th call that changes files fail, while it is used in a `with` block."""

    def __init__(self, n, fault):
        self.n = n
        self.n_calls = 0
        self.fault = FAULTS[fault]
        self.usual = {name: getattr(os, name) for name in CALLS}

    def fail(self):
        if self.fault is None:
            signal.raise_signal(signal.SIGINT)
        else:
            raise self.fault()

    def call(self, name, first, *args, **kwargs):
        is_read = name == "open" and TEMPORARY not in str(first)
        is_compiled = "numba" in str(first) or "jax" in str(first)
        if is_read or is_compiled:
            return self.usual[name](first, *args, **kwargs)
        self.n_calls += 1
        is_last = self.n_calls == self.n
        if is_last and name == "fdopen":
            return HalfWritten(self.usual[name](first, *args, **kwargs), self.fail)
        if is_last:
            self.fail()
        return self.usual[name](first, *args, **kwargs)  # after an interrupt, too

    def __enter__(self):
        for name in CALLS:
            setattr(os, name, functools.partial(self.call, name))
        return self

    def __exit__(self, *error):
        for name, function in self.usual.items():
            setattr(os, name, function)


@pytest.fixture(scope="module")
def workspace():
    return random_cells(2, 3)


@pytest.fixture(scope="module")
def mission(workspace):
    return ModelSimulator(workspace, blind=True).run(OTHER, seed=11)


@pytest.fixture(scope="module")
def template(workspace, tmp_path_factory):
    """Folder of a campaign with two missions, one of them on another course, and a plan."""
    folder = tmp_path_factory.mktemp("faults") / "template"
    with begin(workspace, folder) as campaign:
        for seed, course in enumerate(({}, BACK)):
            plan = campaign.ask(**course)
            told = ModelSimulator(workspace, blind=True).run(plan.path, seed=seed)
            campaign.tell(told.of_robots(plan.robots))
        campaign.ask()
    return folder


OPERATIONS = (
    "tell", "fail", "exclude", "correct", "withdraw", "suggest", "replan", "ask", "ask back",
    "close off", "reopen",
)  # fmt: skip


def operations(campaign, mission):
    def ask():
        if not campaign.state.failures:
            campaign.fail("rain")
        return campaign.ask()

    def withdraw():
        if not campaign.state.failures:
            campaign.fail("stuck")
        if not campaign.state.failures[0].withdrawn:
            campaign.withdraw(1, "wrong team")

    def reopen():
        if not campaign.state.closings:
            campaign.close_off([(1, 1)], "wreck")
        if not campaign.state.closings[0].reopened:
            campaign.reopen(1, "towed away")

    return {
        "close off": lambda: campaign.close_off([(1, 1), ((2, 0), (1, 0))], "mud", until=9),
        "reopen": reopen,
        "tell": lambda: campaign.tell(mission),
        "fail": lambda: campaign.fail("stuck", where=campaign.ask().path[1]),
        "exclude": lambda: campaign.exclude(1, "the lidar was covered"),
        "correct": lambda: campaign.correct(1, mission, "another detector"),
        "withdraw": withdraw,
        "suggest": lambda: campaign.suggest(OTHER),
        "replan": lambda: campaign.replan((2, 0), blocked=[campaign.ask().path[:2]]),
        "ask": ask,
        "ask back": lambda: campaign.ask(**BACK),
    }


def summary(campaign):
    state = campaign.state
    asked = None if state.asked is None else (state.asked.path, state.asked.robots)
    counted = tuple(entry.why_excluded is not None for entry in state.entries)
    failures = tuple(bool(failure.withdrawn) for failure in state.failures)
    closings = tuple((one.where, one.reason, bool(one.reopened)) for one in state.closings)
    return counted, (failures, closings), asked


def attempt(operation):
    """Run an operation; returns "done", "refused" or "interrupted"."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            operation()
    except tb.TrustboError:
        return "refused"
    except KeyboardInterrupt:
        return "interrupted"
    return "done"


def reopened(folder, copy):
    """Summary of the campaign that a process would find if this one died now."""
    shutil.rmtree(copy, ignore_errors=True)
    shutil.copytree(folder, copy)
    with tb.Campaign.load(copy) as campaign:
        return summary(campaign)


def remains(folder):
    return [str(file) for file in folder.rglob("*") if re.match(r"\.(tmp|new|next)", file.name)]


def check(folder, operate, mission, expected, fault):
    """Run an operation with a fault, and check all that must hold; returns the outcome."""
    copy = Path(tempfile.mkdtemp()) / "copy"  # on another disk
    with tb.Campaign.load(folder) as campaign:
        before = summary(campaign)
        with fault:
            outcome = attempt(operations(campaign, mission)[operate])
        after = summary(campaign)
        if operate in ("ask", "withdraw", "reopen") and outcome != "done":
            before = after  # they consist of two operations, of which one may be done
        assert after == before or outcome != "refused"
        assert reopened(folder, copy)[:2] == after[:2]
        if outcome == "done":
            assert reopened(folder, copy) == after
        if operate == "tell" and after != before:
            with pytest.raises(tb.TrustboError, match="mission 3"):
                campaign.tell(mission)
        if after == before and outcome != "done":
            operations(campaign, mission)[operate]()
        campaign.ask()
        assert remains(folder) == []
    with tb.Campaign.load(folder) as campaign:
        same(campaign, expected(operate))
        assert campaign.ask().path == expected(operate).ask().path
    return outcome


@pytest.fixture(scope="module")
def expected(template, mission, tmp_path_factory):
    """A function of an operation: the campaign after it, without a fault."""

    @functools.cache
    def after(name):
        copy = shutil.copytree(template, tmp_path_factory.mktemp("expected") / name)
        with tb.Campaign.load(copy) as campaign:
            operations(campaign, mission)[name]()
            campaign.ask()
        return campaign

    return after


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("operate", OPERATIONS)
@pytest.mark.slow
def test_operation_that_fails_at_any_call_is_recorded_or_not(
    template, mission, expected, tmp_path, operate, fault
):
    for n in itertools.count(1):
        folder = shutil.copytree(template, tmp_path / str(n) / "campaign")
        failing = Failing(n, fault)
        check(folder, operate, mission, expected, failing)
        if failing.n_calls < n:
            break
    assert n > 5  # a file is opened, written, flushed, renamed, and its folder is flushed


@pytest.mark.parametrize("fault", ["full", "interrupt"])
def test_tell_that_fails_at_the_mission_or_at_the_record_is_recorded_or_not(
    template, mission, expected, tmp_path, fault
):
    """The first write, and one of the last ones, of the test above."""
    outcomes = []
    for n in (2, 14):
        folder = shutil.copytree(template, tmp_path / str(n) / "campaign")
        outcomes.append(check(folder, "tell", mission, expected, Failing(n, fault)))
    assert outcomes == (["refused", "done"] if fault == "full" else ["interrupted"] * 2)


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.slow
def test_replacement_that_fails_at_any_call_leaves_the_old_or_the_new_campaign(
    workspace, template, tmp_path, fault
):
    def replace(folder):
        begin(workspace, folder, overwrite=True, seed=9).close()

    for n in itertools.count(1):
        folder = shutil.copytree(template, tmp_path / str(n) / "campaign")
        (folder / "missions" / "thesis.nc").write_text("mine")
        with Failing(n, fault) as failing:
            outcome = attempt(functools.partial(replace, folder))
        with tb.Campaign.load(shutil.copytree(folder, tmp_path / f"{n}-copy")) as campaign:
            found = campaign.settings["seed"], len(campaign.missions)
        assert found in (((9, 0),) if outcome == "done" else ((3, 2), (9, 0)))
        replace(folder)
        with tb.Campaign.load(folder) as campaign:
            assert (campaign.settings["seed"], campaign.missions) == (9, [])
        assert remains(folder) == []
        assert {file.name for file in folder.rglob("*.nc")} == {"workspace.nc", "thesis.nc"}
        if failing.n_calls < n:
            break
    assert n > 20


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.slow
def test_save_that_fails_at_any_call_can_be_repeated(template, tmp_path, fault):
    result = tb.load_result(template)
    for n in itertools.count(1):
        folder = tmp_path / str(n)
        with Failing(n, fault) as failing:
            outcome = attempt(functools.partial(result.save, folder))
        assert (outcome == "done") or not (folder / "campaign.json").exists()
        if outcome != "done":
            result.save(folder)
        same(tb.load_result(folder), result)
        assert remains(folder) == []
        if failing.n_calls < n:
            break
    assert n > 20


@pytest.fixture
def small_disk(tmp_path):
    """File system of 2 MB, where this process may mount one."""
    place = tmp_path / "disk"
    place.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=2m", "tmpfs", str(place)]
    if not shutil.which("mount") or subprocess.run(command, check=False).returncode:
        pytest.skip("this process may not mount a file system")
    yield place
    subprocess.run(["umount", str(place)], check=True)


@contextmanager
def full(disk, n_bytes):
    """Leave room for a number of bytes on a disk."""
    filler = disk / "filler"
    found = os.statvfs(disk)
    filler.write_bytes(b"0" * max(0, found.f_bavail * found.f_frsize - n_bytes))
    yield
    filler.unlink()


@pytest.mark.slow
@pytest.mark.parametrize("operate", OPERATIONS)
def test_operation_on_a_full_disk_is_recorded_or_not(
    template, mission, expected, small_disk, operate
):
    outcomes = set()
    for n_bytes in (0, 4096, 8192, 16384, 65536, 69632, 73728, 131072, 135168, 139264, 147456):
        shutil.rmtree(small_disk / "campaign", ignore_errors=True)
        folder = shutil.copytree(template, small_disk / "campaign")
        fault = full(small_disk, n_bytes)
        outcomes.add(check(folder, operate, mission, expected, fault))
    assert outcomes == {"done", "refused"}
