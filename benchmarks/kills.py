"""Crash test: campaigns of three courses, killed at random, must resume with identical results.

python benchmarks/kills.py [--kills 20]
"""

import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from common import Table, arguments, parsed

import trustbo as tb
from trustbo.models import TrustParams

COURSES = [((3, 0), (0, 3)), ((0, 0), (3, 3)), ((0, 3), (3, 0))]
N_MISSIONS = 8


def simulator():
    """Make a simulator for a workspace of 4 x 4 cells."""
    workspace = tb.Workspace.from_awareness(np.random.default_rng(0).uniform(size=(3, 4, 4, 2)))
    truth = TrustParams(0.6, np.array([0.3, 0.2]), 0.05, 0.05, 0.05)
    return tb.simulation.ModelSimulator(workspace, truth)


def go_on(folder):
    """Start or resume the campaign in a folder, and run it to the end."""
    robots = simulator()
    options = {"simulator": robots, "n_iterations": N_MISSIONS, "progress": False}
    if (Path(folder) / "campaign.json").exists():
        return tb.resume(folder, **options)
    options |= {"courses": COURSES, "policy": "thompson", "directory": folder}
    return tb.iterate(robots.workspace, **options)


def numbers(folder):
    """Return the paths and the draws (as bytes) of a campaign."""
    result = tb.load_result(folder)
    draws = [v.values.tobytes() for t in result.posteriors for v in t["posterior"].values()]
    return [m.path for m in result.missions], result.path, draws


def main():
    """Kill processes at random moments, resume their campaigns, and compare."""
    parser = arguments(__doc__ or "")
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--folder", help="run one campaign here (used by the script itself)")
    given = parsed(parser)
    if given.folder:
        go_on(given.folder)
        return
    rng, n_kills, n_campaigns, n_same = np.random.default_rng(0), 0, 0, 0
    with tempfile.TemporaryDirectory() as root:
        go_on(f"{root}/whole")
        expected = numbers(f"{root}/whole")
        while n_kills < given.kills:
            folder = Path(root) / str(n_campaigns)
            for _ in range(4):
                process = subprocess.Popen([sys.executable, __file__, "--folder", str(folder)])
                record, before = folder / "campaign.json", time.time()
                while process.poll() is None:  # nothing to lose before the record exists
                    if record.exists() and record.stat().st_mtime > before:
                        time.sleep(rng.uniform(0.0, 0.5))
                        process.send_signal(signal.SIGKILL)
                        break
                    time.sleep(0.005)
                n_kills += process.wait() == -signal.SIGKILL
            go_on(folder)
            n_campaigns += 1
            n_same += numbers(folder) == expected
    table = Table("kills", "campaigns", "identical", name="kills")
    table.row(n_kills, n_campaigns, n_same)


if __name__ == "__main__":
    main()
