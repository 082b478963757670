"""Mutation testing: the fraction of 25 faults, inserted into the source, that the tests detect.

Each fault changes one place of the source so that results are wrong but nothing crashes. The fault
is inserted into a copy of the repository, never into the repository itself. The tests of the same
subpackage run until one fails. If none fails, the tests of the neighbouring subpackages run. A test
that also fails without the fault is ignored. If the text to replace is no longer in the source, the
fault cannot be inserted and counts as not detected. Whoever changes such code should adapt the
fault to the new code.

The script searches for the text in the file of the fault and, because code may have moved, in the
whole source. Cached kernels would not notice a change in the kernels that they call. Therefore, a
fault in a file with kernels is tested with an empty cache.
"""

import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import Queue
from typing import NamedTuple

from common import Table, arguments, parsed, timed

ROOT = Path(__file__).resolve().parents[1]
SOURCE = "src/trustbo"
NEIGHBOURS = {
    "statespace": ("models", "inference", "planning"),
    "models": ("inference", "criticism", "campaign"),
    "inference": ("models", "criticism", "campaign"),
    "hazard": ("campaign", "planning"),
    "planning": ("campaign", "simulation"),
    "workspace": ("planning", "simulation", "terrain"),
    "terrain": ("workspace", "simulation"),
    "simulation": ("campaign", "study"),
    "campaign": ("cli", "study"),
    "export": ("cli",),
}
"""Neighbouring subpackages, whose tests run in addition, keyed by subpackage."""


class Fault(NamedTuple):
    """Change of the source that makes results wrong: replace `before` with `after` in `file`."""

    name: str
    file: str
    before: str
    after: str


WRITTEN = """\
            self.storage.write(state)
"""
CHANGED = """\
            self.state = state
"""
FAULTS = (
    Fault("the evidence has the wrong sign of the residuals' square", "inference/engine.py",
          "prior.log_det - (w**2).sum((1, 2))", "prior.log_det + (w**2).sum((1, 2))"),
    Fault("trust before the first bound has no mean", "statespace/form.py",
          "mean = (of_start * self.initial_mean[..., None, :]).sum(-1)",
          "mean = 0.0 * (of_start * self.initial_mean[..., None, :]).sum(-1)"),
    Fault("the filter ignores what a rate says of trust", "statespace/kalman.py",
          "mean = mean + gain * (m_after - m)[..., None]", "mean = mean + 0.0 * gain"),
    Fault("a mixture of proposals ignores their sizes", "inference/importance.py",
          "np.array(self._log_q) + log_share[:, None]", "np.array(self._log_q)"),
    Fault("weights that leave out a mission have the wrong sign", "inference/loo.py",
          "whole - fitted.without(j).log_evidence(theta)",
          "fitted.without(j).log_evidence(theta) - whole"),
    Fault("a bound that failed is also counted as passed", "hazard/risk.py",
          "b += trials - failures", "b += trials"),
    Fault("the margin raises the slope limit", "hazard/prior.py",
          "(steepness[j] + limit[i, 0])", "(steepness[j] - limit[i, 0])"),
    Fault("the loss of a bound is clipped a second time", "planning/problem.py",
          "return objective.value(-lost.sum(-1) - bound_cost)",
          "return objective.value(-lost.clip(0.0, 1.0).sum(-1) - bound_cost)"),
    Fault("'shortest+4' admits 3 more bounds only", "planning/paths.py",
          "self.shortest + int(named[1] or 0)", "self.shortest + max(int(named[1] or 0) - 1, 0)"),
    Fault("moves along a path have rows and columns transposed", "workspace/moves.py",
          "index = 3 * (steps[:, 0] + 1) + steps[:, 1] + 1",
          "index = 3 * (steps[:, 1] + 1) + steps[:, 0] + 1"),
    Fault("components count alike in the price of a failure", "planning/problem.py",
          "EdgeRisks(risks, self.cost_of_failure, weights, limit)",
          "EdgeRisks(risks, self.cost_of_failure, np.full_like(weights, 0.2), limit)"),
    Fault("of equally good paths the longest is planned", "planning/sums.py",
          "if score > scores[d]:", "if score >= scores[d]:"),
    Fault("a bound has the awareness of the cell that it leaves", "workspace/moves.py",
          "np.column_stack([ways, cells_along(path)[1:]])",
          "np.column_stack([ways, cells_along(path)[:-1]])"),
    Fault("a path forgets the posts", "planning/paths.py",
          "[(row, col, POST_SETS[k]) for", "[(row, col, POST_SETS[0]) for"),
    Fault("sets of posts of a bound are independent", "models/effects/place.py",
          "if (n_ways == 1).all():", "if True:"),
    Fault("the second-best path may enter the same cell", "planning/unrolled.py",
          "again = at >= 0 and head[at] == h", "again = False"),
    Fault("heights of sensor and target are exchanged", "workspace/sight.py",
          "watcher.sensor_height,\n        watched.target_height,",
          "watched.target_height,\n        watcher.sensor_height,"),
    Fault("missing pixels count as 0 in the mean of a cell", "workspace/grid.py",
          "np.add.at(count[row], cols[valid], 1.0)", "np.add.at(count[row], cols, 1.0)"),
    Fault("canopy attenuates by pixels, not by metres", "terrain/rays.py",
          "math.sqrt((dr * pixel[0]) ** 2 + (dc * pixel[1]) ** 2 + dz**2)",
          "math.sqrt(dr**2 + dc**2 + dz**2)"),
    Fault("the sign of an index is not the declared one", "terrain/composite.py",
          "np.sign(first @ signs[varies]) or 1.0", "np.sign(first.sum()) or 1.0"),
    Fault("the truth's best path ends on the last bound but one", "simulation/truth.py",
          "last = (passed * contact)[:, *goal, n_ways]", "last = (passed * contact)[:, *goal, 0]"),
    Fault("a fit takes the seeds of the policy", "campaign/learning.py",
          "seed=state.seed_of_fit", 'seed=state.seed_of("policy")'),
    Fault("a mission is learned from before it is on disk", "campaign/campaign.py",
          WRITTEN + CHANGED, CHANGED + WRITTEN),
    Fault("the y axis of a map for ROS is flipped", "export/nav2.py",
          "values[::-1].tobytes()", "values.tobytes()"),
    Fault("effects of robots belong to the robots in reverse", "models/effects/robot.py",
          "where = (robot * n_missions + mission).ravel()",
          "where = ((n_robots - 1 - robot) * n_missions + mission).ravel()"),
    Fault("the prior scales of effects are doubled", "models/effects/effect.py",
          "name: dist.HalfNormal(getattr(self, name))",
          "name: dist.HalfNormal(2.0 * getattr(self, name))"),
    Fault("a rate that was not measured counts as 0", "inference/engine.py",
          "seen = ~np.isnan(y)", "seen = np.ones(np.shape(y), dtype=bool)"),
    Fault("frames are rotated the other way", "export/nav2.py",
          "np.array([[c, -s], [s, c]])", "np.array([[c, s], [-s, c]])"),
)  # fmt: skip


def place_of(fault: Fault, root: Path = ROOT) -> Path | None:
    """Return the only file with the text of a fault; None if there is no single place."""
    source = root / SOURCE
    for files in ([source / fault.file], sorted(source.rglob("*.py"))):
        found = {f: f.read_text().count(fault.before) for f in files if f.is_file()}
        found = {file: n for file, n in found.items() if n}
        if found:
            return next(iter(found)) if list(found.values()) == [1] else None
    return None


def copy_to(folder: Path) -> Path:
    """Copy all tracked files, including uncommitted changes, to a folder."""
    listed = subprocess.check_output(["git", "ls-files", "-z"], cwd=ROOT, text=True)
    for name in filter(None, listed.split("\0")):
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / name)
    return folder


def first_failure(copy: Path, kernels: Path, tests: Sequence[str], minutes: float) -> str | None:
    """Run tests in a copy; return the name of the first test that fails, or None if all pass.

    The folder `kernels` caches compiled kernels. Raises RuntimeError if pytest did not run.
    """
    paths = [str(copy / folder) for folder in ("src", "tests", "benchmarks")]
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(paths),
        "XLA_FLAGS": "--xla_backend_optimization_level=0",
        "NUMBA_CACHE_DIR": str(kernels),
        "XDG_CACHE_HOME": str(copy / ".cache"),
    }
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-m", "not slow", "--no-header"]
    try:
        done = subprocess.run(
            [*command, "--tb=no", "-p", "no:cacheprovider", *tests], cwd=copy, env=environment,
            capture_output=True, text=True, timeout=60.0 * minutes, check=False,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        raise RuntimeError(f"no test failed within {minutes:g} minutes") from None
    if failed := re.search(r"^(?:FAILED|ERROR) (.+?)(?: - .*)?$", done.stdout, re.MULTILINE):
        return failed[1]
    if done.returncode not in (0, 5):  # 5: all tests are slow and were deselected
        raise RuntimeError(f"pytest did not run: {(done.stdout + done.stderr)[-300:]}")
    return None


def stages(fault: Fault, copy: Path, reach: str) -> Iterator[list[str]]:
    """Yield the groups of test folders to run, one after the other."""
    room = fault.file.split("/")[0]
    for folders in ((room,), NEIGHBOURS[room] if reach != "room" else ()):
        if there := [f"tests/{name}" for name in folders if (copy / "tests" / name).is_dir()]:
            yield there
    if reach == "whole":
        yield ["tests"]


def caught_by(fault: Fault, copy: Path, reach: str, minutes: float) -> tuple[bool, str]:
    """Return whether the tests detect a fault, and the test that failed or another outcome."""
    if (file := place_of(fault, copy)) is None:
        return False, "not inserted: the code has changed"
    text, ran, unfit = file.read_text(), [], []
    kernels = copy / ".kernels"
    if "njit" in text:
        kernels = Path(tempfile.mkdtemp(dir=copy))
    try:
        for folders in stages(fault, copy, reach):
            while True:
                left_out = [f"--deselect={test}" for test in unfit]
                file.write_text(text.replace(fault.before, fault.after))
                failed = first_failure(copy, kernels, [*folders, *left_out], minutes)
                file.write_text(text)
                if failed is None:
                    break
                if first_failure(copy, copy / ".kernels", [failed], minutes) is None:
                    return True, failed
                unfit.append(failed)
            ran += folders
    except RuntimeError as error:
        return False, f"unknown: {error}"
    finally:
        file.write_text(text)
    return False, f"NOT DETECTED by {', '.join(ran)}"


def main() -> None:
    parser = arguments(__doc__, quick="only locate the faults in the source; run no tests")
    parser.add_argument("--only", action="append", metavar="NAME",
                        help="faults whose names contain this text; can be repeated")  # fmt: skip
    parser.add_argument("--reach", choices=("room", "near", "whole"), default="near",
                        help="tests of the subpackage, with its neighbours, or all")  # fmt: skip
    parser.add_argument("--jobs", type=int, default=1, help="faults tested in parallel (default 1)")
    parser.add_argument("--minutes", type=float, default=30.0, help="limit per run (default 30)")
    given = parsed(parser)
    faults = [f for f in FAULTS if not given.only or any(name in f.name for name in given.only)]
    table, n_caught = Table("fault", "detected by", "seconds", first=54), 0
    if given.quick:
        for fault in faults:
            table.row(fault.name, place_of(fault) or "not inserted: the code has changed", "")
        return
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(given.jobs) as pool:
        copies: Queue[Path] = Queue()
        for job in range(given.jobs):
            copies.put(copy_to(Path(folder) / str(job)))

        def run(fault: Fault) -> tuple[float, tuple[bool, str]]:
            copy = copies.get()
            try:
                return timed(lambda: caught_by(fault, copy, given.reach, given.minutes))
            finally:
                copies.put(copy)

        for fault, (seconds, (caught, how)) in zip(faults, pool.map(run, faults), strict=True):
            n_caught += caught
            table.row(fault.name, how, f"{seconds:.0f}")
    print(f"detected {n_caught} of {len(faults)}")


if __name__ == "__main__":
    main()
