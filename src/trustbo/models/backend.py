"""Import of numpyro with its submodules, and the JAX settings of all computations.

Without ipywidgets, a kernel of Jupyter is warned of it when numpyro is imported ("IProgress not
found"); the warning is silenced, as text bars suffice.

arviz_base leaves a lazy numpyro in `sys.modules`. A caller that then imports a submodule of it
first, as in `import arviz; import numpyro.distributions`, gets packages without their submodules,
and numpyro fails ("numpyro.distributions has no attribute 'distribution'"). To ask the package for
something first avoids it; where it has happened already, the submodules are put in their places.
"""

import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from importlib.metadata import version
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy import special

with warnings.catch_warnings():
    warnings.filterwarnings("ignore", "IProgress not found")
    import numpyro

VERSIONS: dict[str, str] = {
    "trustbo": version("trustbo"),
    "numpyro": numpyro.__version__,
    "jax": jax.__version__,
}
"""Versions recorded in posteriors; cached, as each lookup takes 4 ms."""

for _name, _module in list(sys.modules.items()):
    _package, _, _child = _name.rpartition(".")
    if _package.startswith("numpyro") and not hasattr(sys.modules[_package], _child):
        setattr(sys.modules[_package], _child, _module)


def namespace(x: Any) -> ModuleType:
    """`jax.numpy` for arrays of JAX, else NumPy: formulas written once serve both."""
    return jnp if isinstance(x, jax.Array) else np


def special_functions(x: Any) -> Any:
    """`jax.scipy.special` for arrays of JAX, else SciPy's."""
    return jax.scipy.special if isinstance(x, jax.Array) else special


@partial(jax.jit, static_argnums=1)
def call(prior: Any, method: str, x: jax.Array) -> jax.Array:
    """Call a method of a distribution as one program; else each operation in it is compiled."""
    return getattr(prior, method)(x)


@contextmanager
def own_settings() -> Iterator[None]:
    """Compute in float64 with one random number generator, for any JAX flags of the caller."""
    with (
        jax.enable_x64(True),
        jax.default_prng_impl("threefry2x32"),
        jax.threefry_partitionable(True),
        jax.numpy_rank_promotion("allow"),
        jax.numpy_dtype_promotion("standard"),
    ):
        yield
