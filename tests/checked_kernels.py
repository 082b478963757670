"""Kernels under checks of their indices: python tests/checked_kernels.py TESTS...

Runs tests in this process, for which the environment turns the checks on, with a cache of its own.
Prints the kernels of the package that no test compiled, as a line of JSON.
"""

import importlib
import json
import re
import sys
from pathlib import Path

import pytest
from numba.core import config
from numba.core.registry import CPUDispatcher

import trustbo

_PACKAGE = Path(trustbo.__file__).parent
_IMPORT = re.compile(r"^from trustbo(\.kernels)? import .*kernel", re.MULTILINE)


def kernels():
    """All compiled functions of the package by name."""
    found = {}
    for path in sorted(_PACKAGE.rglob("*.py")):
        if not _IMPORT.search(path.read_text()):
            continue
        name = ".".join(["trustbo", *path.relative_to(_PACKAGE).with_suffix("").parts])
        for key, value in vars(importlib.import_module(name)).items():
            if isinstance(value, CPUDispatcher) and value.py_func.__module__ == name:
                found[f"{name}.{key}"] = value
    return found


def never_compiled():
    """Kernels that were not compiled here; the inlined are compiled with those that call them."""
    return [
        name
        for name, kernel in kernels().items()
        if not kernel.signatures and kernel.targetoptions.get("inline") != "always"
    ]


if __name__ == "__main__":
    assert config.BOUNDSCHECK, "set NUMBA_BOUNDSCHECK=1"
    status = pytest.main(["-q", "-p", "no:cacheprovider", "-p", "no:xdist", *sys.argv[1:]])
    sys.stdout.write(
        "\n" + json.dumps({"kernels": len(kernels()), "never compiled": never_compiled()})
    )
    sys.exit(status)
