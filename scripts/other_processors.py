"""Run the tests with the arithmetic of other processors, and count the tests that pass.

    python scripts/other_processors.py [--each] [arguments of pytest]

OpenBLAS, NumPy, Numba and XLA select instructions for the processor, so the last digits of results
differ between processors. A setting makes one of these libraries compute as on another processor.
Settings that this processor or build does not support are skipped and listed. Each run of the tests
combines one setting of each library; with `--each`, every setting has its own run. Without
arguments of pytest, a run is the same as `make test`. Compiled code is stored per setting: the
script ends with an error if two settings that compile differently share a folder.
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
"""Flag that makes XLA compile faster."""

CACHE = "TRUSTBO_CACHE"
"""Variable with the folder of compiled code."""
COMPILERS = "NUMBA_CPU_NAME", "XLA_FLAGS"
"""Variables of settings that change compiled code."""

DISPATCHED = [name for name in __cpu_dispatch__ if __cpu_features__[name]]
"""Features of this processor that NumPy uses and that can be disabled."""
AVX512 = [name for name in DISPATCHED if name.startswith("AVX512") or name == "X86_V4"]
CORES = ("Haswell", "SkylakeX", "Zen", "Nehalem")
"""Core types of OpenBLAS. Nehalem has neither AVX nor fused multiply-add."""


class Setting(NamedTuple):
    """Environment variable that makes one library compute as on another processor.

    Attributes:
        variable: Name of the variable.
        value: Value of the variable.
        lacking: Why this machine does not support the setting; empty if supported.
    """

    variable: str
    value: str
    lacking: str = ""

    def __str__(self) -> str:
        return f"{self.variable}={self.value}"


def openblas(core: str) -> Setting:
    """Make the setting of a core type, and try it in a separate process because it may crash."""
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
        lacking = "a matrix product crashes with this core type"
    elif (used := tried.stdout.strip()) != str({core}):
        lacking = f"this build of OpenBLAS uses {used} instead"
    return Setting("OPENBLAS_CORETYPE", core, lacking)


def numpy(features: list[str], name: str) -> Setting:
    """Make the setting of NumPy without these features, a group called `name`."""
    lacking = "" if features else "NumPy uses none of these features on this processor"
    return Setting("NPY_DISABLE_CPU_FEATURES", " ".join(features) or name, lacking)


def xla(isa: str) -> Setting:
    """Make the setting of XLA that uses no instructions beyond `isa`."""
    return Setting("XLA_FLAGS", f"{NOT_OPTIMISED} --xla_cpu_max_isa={isa}")


def settings_by_library() -> list[list[Setting]]:
    """Return the settings of OpenBLAS, NumPy, Numba and XLA."""
    return [
        [openblas(core) for core in CORES],
        [numpy(AVX512, "AVX-512"), numpy(DISPATCHED, "all")],
        [Setting("NUMBA_CPU_NAME", "generic")],
        [xla("AVX2"), xla("SSE4_2")],
    ]


def folder_of(settings: list[Setting]) -> str:
    """Return the name of the folder in which code is stored under these settings."""
    code = "from trustbo.compiled import folder_of; print(folder_of('jax', '0').name)"
    with tempfile.TemporaryDirectory() as folder:
        environment = os.environ | {s.variable: s.value for s in settings} | {CACHE: folder}
        command = [sys.executable, "-c", code]
        return subprocess.check_output(command, env=environment, text=True).strip()


def outcome(case: ElementTree.Element) -> str:
    """Return whether a test passed, failed or was skipped."""
    tags = {child.tag for child in case}
    if tags & {"failure", "error"}:
        return "failed"
    return "skipped" if "skipped" in tags else "passed"


def run(settings: list[Setting], arguments: list[str]) -> tuple[Counter[str], list[str]]:
    """Run the tests once; return the number of tests by outcome, and the names of failed tests."""
    print(f"\n=== {', '.join(map(str, settings)) or 'this processor'}", flush=True)
    environment = (
        os.environ
        # Programs are stored as for users, not in the cache of JAX that conftest.py would set up.
        | {"XLA_FLAGS": NOT_OPTIMISED, "JAX_COMPILATION_CACHE_DIR": "", CACHE: str(ROOT / ".cache")}
        | {s.variable: s.value for s in settings}
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
    """Run the tests without settings and then with each combination, and print a table."""
    arguments = [argument for argument in sys.argv[1:] if argument != "--each"] or ["tests"]
    libraries = settings_by_library()
    here = [[setting for setting in library if not setting.lacking] for library in libraries]
    if "--each" in sys.argv:
        passes = [[setting] for library in here for setting in library]
    else:
        passes = [[setting for setting in row if setting] for row in zip_longest(*here)]

    compilers = [s for row in here for s in row if s.variable in COMPILERS]
    folders = {folder_of(settings) for settings in [[], *([s] for s in compilers)]}
    if len(folders) <= len(compilers):
        sys.exit("some settings that compile differently store code in one folder")

    rows = [(settings, *run(settings, arguments)) for settings in [[], *passes]]

    print("\n  passed  failed skipped  setting")
    for settings, counts, failed in rows:
        numbers = "".join(f"{counts[kind]:8}" for kind in ("passed", "failed", "skipped"))
        for setting in settings or ["none: this processor"]:
            print(f"{numbers}  {setting}")
        for name in failed:
            print(f"{'':26}{name}")
    for setting in (setting for library in libraries for setting in library if setting.lacking):
        print(f"{'skipped':>24}  {setting}: {setting.lacking}")
    sys.exit(any(failed for _, _, failed in rows))


if __name__ == "__main__":
    main()
