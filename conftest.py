"""Environment of the tests and the notebooks, and of the processes that they start."""

import os
from pathlib import Path

_CACHE = Path(__file__).resolve().parent / ".cache"

# Workers, kernels and subprocesses share their compiled programs. numpyro lists the parameters of
# a distribution in the order of a set of names: only under one hash seed is a program found again.
for _name, _value in {
    "JAX_COMPILATION_CACHE_DIR": str(_CACHE / "jax"),
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
    "HYPOTHESIS_STORAGE_DIRECTORY": str(_CACHE / "hypothesis"),
    "PYTHONHASHSEED": "0",
    "OPENBLAS_NUM_THREADS": "1",  # there is a worker for each core, and threads spin
}.items():
    os.environ.setdefault(_name, _value)
