"""Campaigns killed by SIGKILL while the posterior's and the report's files are being written.

Run: python benchmarks/endurance.py [-n 20] [--quick]

Each process begins a campaign of three missions and writes its report, and kills itself at one
moment: when half of a file is written under its temporary name, or when the file has just got its
name. Another process opens the folder. Counted are missions that were told and are not there, files
under their own names that are not whole, and folders with which nothing can go on to the same end.
What a mission of a long campaign costs, in seconds, memory and disk: benchmarks/campaigns.py.
"""

import os
import signal
import tempfile
import traceback
import warnings
from pathlib import Path

import numpy as np
from common import arguments, parsed

import trustbo as tb
import trustbo.files
from trustbo.logs.netcdf import read_tree
from trustbo.models import TrustParams

ENDS, MISSIONS = ((2, 0), (0, 2)), 3
TRUTH = TrustParams(0.6, np.array([0.3, 0.2]), 0.05, 0.05, 0.05)
FILES = (
    "posteriors/0001.nc", "posteriors/0002.nc", "posteriors/0003.nc", "posterior.nc",
    "report.html", "explore.html", "result.json",
)  # fmt: skip
MOMENTS = [(name, whole) for name in FILES for whole in (False, True)]


def begin(folder):
    workspace = tb.Workspace.from_awareness(np.random.default_rng(0).uniform(size=(2, 3, 3, 2)))
    if (folder / "campaign.json").exists():
        return tb.Campaign.load(folder), tb.simulation.ModelSimulator(workspace, TRUTH)
    campaign = tb.Campaign(workspace, *ENDS, sampler="exact", policy="thompson", directory=folder)
    return campaign, tb.simulation.ModelSimulator(workspace, TRUTH)


def finish(folder, told):
    """Run what is left of the campaign and write the report; `told` gets a line a mission."""
    from trustbo.report import write_report

    campaign, simulator = begin(folder)
    with campaign:
        while len(campaign.missions) < MISSIONS:
            campaign.tell(simulator.run(campaign.ask().path, seed=campaign.seed_of("mission")))
            with told.open("a") as stream:
                stream.write("told\n")
        result = campaign.stop("n_iterations")
    write_report(folder / "report.html", result)
    return result


def die_at(folder, name, whole):
    """Kill this process when half of a file is written, or when it has its name."""
    replace_file = os.replace

    def replaced(temporary, target):
        if Path(target) == folder / name:
            if whole:
                replace_file(temporary, target)
            else:
                os.truncate(temporary, Path(temporary).stat().st_size // 2)
            os.kill(os.getpid(), signal.SIGKILL)
        replace_file(temporary, target)

    trustbo.files.os.replace = replaced


def in_a_process(work, *arguments):
    """Signal or exit code of a process of its own."""
    child = os.fork()
    if child == 0:
        warnings.simplefilter("ignore")
        code = 1
        try:
            work(*arguments)
            code = 0
        except BaseException:
            traceback.print_exc()
        os._exit(code)
    _, status = os.waitpid(child, 0)
    return os.waitstatus_to_exitcode(status)


def killed(folder, told, name, whole):
    die_at(folder, name, whole)
    finish(folder, told)


def check(folder, told, undisturbed):
    """Raise AssertionError for what was lost, is half, or does not go on as it would have."""
    n = len(told.read_text().splitlines()) if told.exists() else 0
    for file in folder.rglob("*"):
        if file.name.startswith(".") or not file.is_file():
            continue
        if file.suffix == ".nc":
            read_tree(file)
        elif file.suffix == ".html":
            assert file.read_text(encoding="utf-8").rstrip().endswith("</html>"), file
    if (folder / "result.json").exists():
        assert len(tb.load_result(folder).missions) >= n
    with tb.Campaign.load(folder) as campaign:
        assert len(campaign.missions) >= n, f"{len(campaign.missions)} missions of {n}"
    result, whole = finish(folder, told), tb.load_result(undisturbed)
    assert result.path == whole.path
    for one, other in zip(result.posteriors, whole.posteriors, strict=True):
        assert one["posterior"].to_dataset().equals(other["posterior"].to_dataset())
    leftovers = [f for f in folder.rglob(".*") if ".trustbo-" in f.name and f.suffix != ".html"]
    assert not leftovers, leftovers


def main():
    given = parsed(arguments(__doc__, n=20, quick="2 moments"))
    moments = MOMENTS[: 2 if given.quick else given.n]
    with tempfile.TemporaryDirectory() as parent:
        undisturbed = Path(parent) / "undisturbed"
        assert in_a_process(finish, undisturbed, Path(parent) / "all") == 0
        good, died = 0, 0
        for j, (name, whole) in enumerate(moments):
            folder, told = Path(parent) / str(j), Path(parent) / f"told{j}"
            died += in_a_process(killed, folder, told, name, whole) == -signal.SIGKILL
            ok = in_a_process(check, folder, told, undisturbed) == 0
            good += ok
            print(f"{name}, {'whole' if whole else 'half'}: {'as it was' if ok else 'LOST'}")
        n = len(moments)
        print(f"{n} moments, {died} killed by SIGKILL, {good} opened and came to the same end")


if __name__ == "__main__":
    main()
