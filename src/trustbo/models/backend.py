"""Import of numpyro with its submodules, and JAX settings for all computations.

In Jupyter without ipywidgets, importing numpyro warns "IProgress not found"; the warning is
silenced, as text progress bars suffice.

arviz_base leaves a lazy numpyro in `sys.modules`. If a submodule is imported first, as in `import
arviz; import numpyro.distributions`, packages lack their submodules and numpyro fails
("numpyro.distributions has no attribute 'distribution'"). Accessing an attribute of the package
first avoids this; where it has already happened, the submodules are set as attributes.
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
from scipy.linalg import lapack

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
    """Return `jax.numpy` for JAX arrays, else NumPy, so that one formula serves both."""
    return jnp if isinstance(x, jax.Array) else np


def special_functions(x: Any) -> Any:
    """Return `jax.scipy.special` for JAX arrays, else `scipy.special`."""
    return jax.scipy.special if isinstance(x, jax.Array) else special


def inverse(A: Any) -> Any:
    """Invert positive definite matrices (point, n, n); NaN where one is not."""
    if isinstance(A, jax.Array):
        return jnp.linalg.inv(A)
    half = A.copy()
    for one in half:  # symmetric, so its transpose, in LAPACK's order of axes, is the same matrix
        if lapack.dpotrf(one.T, lower=1, overwrite_a=1)[1]:  # pyright: ignore[reportAttributeAccessIssue]
            one[:] = np.nan
        lapack.dpotri(one.T, lower=1, overwrite_c=1)  # pyright: ignore[reportAttributeAccessIssue]
    return half + np.swapaxes(np.triu(half, 1), 1, 2)


@partial(jax.jit, static_argnums=1)
def call(prior: Any, method: str, x: jax.Array) -> jax.Array:
    """Call a method of a distribution as one compiled program, not one per operation."""
    return getattr(prior, method)(x)


@contextmanager
def own_settings() -> Iterator[None]:
    """Compute in float64 with one random number generator, whatever the caller's JAX flags."""
    with (
        jax.enable_x64(True),
        jax.default_prng_impl("threefry2x32"),
        jax.threefry_partitionable(True),
        jax.numpy_rank_promotion("allow"),
        jax.numpy_dtype_promotion("standard"),
    ):
        yield
