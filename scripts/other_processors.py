"""Run the tests as other processors would, and print how many pass under each setting.

    python scripts/other_processors.py [--each] [arguments of pytest]

OpenBLAS, NumPy, Numba and XLA choose their instructions by the processor, so the last digits differ
from one processor to the next. Each setting makes one of the four compute as on another processor;
those that this processor or this build lacks are named and left out. A pass of the suite takes one
setting of each library; `--each` gives every setting its own pass. Without arguments of pytest a
pass is that of `make test`. The caches stay apart: Numba's by the processor's name, JAX's by flags.
"""

import os
import subprocess
import sys
import tempfile
from collections import Counter
from itertools import zip_longest
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

from numpy._core._multiarray_umath import __cpu_dispatch__, __cpu_features__

ROOT = Path(__file__).resolve().parents[1]
PYTEST = [sys.executable, "-m", "pytest", "-q", "--numprocesses", "2", "--dist", "worksteal"]
NOT_OPTIMISED = "--xla_backend_optimization_level=0"
"""As in the Makefile."""

DISPATCHED = [name for name in __cpu_dispatch__ if __cpu_features__[name]]
"""Features of this processor that NumPy uses where it finds them, and can be told not to use."""
AVX512 = [name for name in DISPATCHED if name.startswith("AVX512") or name == "X86_V4"]
CORES = ("Haswell", "SkylakeX", "Zen", "Nehalem")
"""Core types of OpenBLAS; the last has neither AVX nor fused multiplication and addition."""


class Setting(NamedTuple):
    """An environment variable that makes one library compute as on another processor.

    Attributes:
        variable: Name of the variable.
        value: Its value.
        lacking: Why it cannot be set here; empty if it can.
    """

    variable: str
    value: str
    lacking: str = ""

    def __str__(self) -> str:
        return f"{self.variable}={self.value}"


def openblas(core: str) -> Setting:
    """The setting of a core type, which is tried in a process of its own, as it may crash."""
    code = (
        "import numpy as np, scipy.linalg, threadpoolctl\n"
        "a = np.random.default_rng(0).random((500, 500))\n"
        "scipy.linalg.cholesky(a @ a.T + np.eye(500)) @ (a @ a)\n"
        "print({pool.get('architecture') for pool in threadpoolctl.threadpool_info()})\n"
    )
    command, environment = [sys.executable, "-c", code], os.environ | {"OPENBLAS_CORETYPE": core}
    tried = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    lacking = ""
    if tried.returncode != 0:
        lacking = "a product of matrices crashes under it here"
    elif (taken := tried.stdout.strip()) != str({core}):
        lacking = f"this build of OpenBLAS takes {taken} for it"
    return Setting("OPENBLAS_CORETYPE", core, lacking)


def numpy(features: list[str], name: str) -> Setting:
    """The setting of NumPy without some features, which have a name together."""
    lacking = "" if features else "NumPy uses none of it on this processor"
    return Setting("NPY_DISABLE_CPU_FEATURES", " ".join(features) or name, lacking)


def xla(isa: str) -> Setting:
    """The setting of XLA with an instruction set at most."""
    return Setting("XLA_FLAGS", f"{NOT_OPTIMISED} --xla_cpu_max_isa={isa}")


def settings_by_library() -> list[list[Setting]]:
    """Settings of OpenBLAS, NumPy, Numba and XLA."""
    return [
        [openblas(core) for core in CORES],
        [numpy(AVX512, "AVX-512"), numpy(DISPATCHED, "all")],
        [Setting("NUMBA_CPU_NAME", "generic")],
        [xla("AVX2"), xla("SSE4_2")],
    ]


def outcome(case: ElementTree.Element) -> str:
    """Whether a test passed, failed or was skipped."""
    tags = {child.tag for child in case}
    if tags & {"failure", "error"}:
        return "failed"
    return "skipped" if "skipped" in tags else "passed"


def run(settings: list[Setting], arguments: list[str]) -> tuple[Counter[str], list[str]]:
    """Number of tests by outcome, and names of those that failed, of one pass."""
    print(f"\n=== {', '.join(map(str, settings)) or 'this processor'}", flush=True)
    environment = (
        os.environ | {"XLA_FLAGS": NOT_OPTIMISED} | {s.variable: s.value for s in settings}
    )
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.xml"
        command = [*PYTEST, "-m", "not slow", f"--junitxml={report}", *arguments]
        done = subprocess.run(command, cwd=ROOT, env=environment, check=False)
        if not report.exists():
            return Counter(failed=1), [f"pytest ended with status {done.returncode}"]
        cases = list(ElementTree.parse(report).iter("testcase"))
    failed = [f"{c.get('classname')}::{c.get('name')}" for c in cases if outcome(c) == "failed"]
    return Counter(map(outcome, cases)), failed


def main() -> None:
    """Run all passes, the first with nothing set, and print the table."""
    arguments = [argument for argument in sys.argv[1:] if argument != "--each"] or ["tests"]
    libraries = settings_by_library()
    here = [[setting for setting in library if not setting.lacking] for library in libraries]
    if "--each" in sys.argv:
        passes = [[setting] for library in here for setting in library]
    else:
        passes = [[setting for setting in row if setting] for row in zip_longest(*here)]
    rows = [(settings, *run(settings, arguments)) for settings in [[], *passes]]

    print("\n  passed  failed skipped  setting")
    for settings, counts, failed in rows:
        numbers = "".join(f"{counts[kind]:8}" for kind in ("passed", "failed", "skipped"))
        for setting in settings or ["none: this processor"]:
            print(f"{numbers}  {setting}")
        for name in failed:
            print(f"{'':26}{name}")
    for setting in (setting for library in libraries for setting in library if setting.lacking):
        print(f"{'left out':>24}  {setting}: {setting.lacking}")
    sys.exit(any(failed for _, _, failed in rows))


if __name__ == "__main__":
    main()
