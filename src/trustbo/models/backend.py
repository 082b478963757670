"""Import numpyro and its submodules, and define the JAX settings for all computations.

In Jupyter without ipywidgets, importing numpyro issues the warning "IProgress not found". The
warning is silenced because text progress bars suffice.

arviz_base leaves a lazily loaded numpyro in `sys.modules`. If a submodule is imported first, as in
`import arviz; import numpyro.distributions`, Python executes that package twice, and the second one
lacks its submodules as attributes. Accessing an attribute of numpyro first, as below, avoids this
problem.
"""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from importlib.metadata import version
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy import special
from scipy.linalg import lapack

with warnings.catch_warnings():
    warnings.filterwarnings("ignore", "IProgress not found")
    import numpyro

    numpyro.__version__  # noqa: B018  (loads a numpyro that arviz_base has left unloaded)

VERSIONS: dict[str, str] = {
    "trustbo": version("trustbo"),
    "numpyro": numpyro.__version__,
    "jax": jax.__version__,
}
"""Versions recorded in posteriors, cached because each lookup takes 4 ms."""


def library_attrs(sampler: str) -> dict[str, str]:
    """Return the attributes of a posterior that name the libraries that made it.

    They include those that ArviZ writes, except for the time, so that a campaign that is resumed
    gives the same files.
    """
    sampled_by = "numpyro" if sampler == "nuts" else "trustbo"
    return {
        "creation_library": "trustbo",
        "creation_library_version": VERSIONS["trustbo"],
        "creation_library_language": "Python",
        "inference_library": sampled_by,
        "inference_library_version": VERSIONS[sampled_by],
        **{f"{name}_version": version for name, version in VERSIONS.items()},
    }


def special_functions(x: Any) -> Any:
    """Return `jax.scipy.special` for a JAX array, otherwise `scipy.special`."""
    return jax.scipy.special if isinstance(x, jax.Array) else special


def inverse(A: Any) -> Any:
    """Invert positive definite matrices (point, n, n); in NumPy, other matrices give NaN."""
    if isinstance(A, jax.Array):
        return inverse_and_log_det(A)[0]

    H = A.copy()
    for one in H:  # `one.T` equals the symmetric `one`, and has LAPACK's memory order
        _, failed = lapack.dpotrf(one.T, lower=1, overwrite_a=1)  # pyright: ignore[reportAttributeAccessIssue]
        if failed:
            one[:] = np.nan
    return inverse_from_factor(H)


def inverse_from_factor(H: np.ndarray) -> np.ndarray:
    """Compute (H' H)^-1 for upper triangular matrices H (point, n, n), which are overwritten."""
    for one in H:
        lapack.dpotri(one.T, lower=1, overwrite_c=1)  # pyright: ignore[reportAttributeAccessIssue]
    return H + np.swapaxes(np.triu(H, 1), 1, 2)


@jax.custom_vjp
def inverse_and_log_det(A: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Invert positive definite matrices (..., n, n) in JAX; also return their log determinants.

    The derivatives are products of the inverse. They compile in a third of the time that JAX takes
    to compile the derivatives of its factorisations.
    """
    L = jax.lax.linalg.cholesky(A, symmetrize_input=False)
    one = jnp.broadcast_to(jnp.eye(A.shape[-1]), A.shape)
    half = jax.lax.linalg.triangular_solve(L, one, left_side=True, lower=True)

    log_det = 2.0 * jnp.log(jnp.diagonal(L, axis1=-2, axis2=-1)).sum(-1)
    return half.mT @ half, log_det


def _with_inverse(A: jax.Array) -> tuple[tuple[jax.Array, jax.Array], jax.Array]:
    """Return the values of `inverse_and_log_det`, and what their derivatives need."""
    found = inverse_and_log_det(A)
    return found, found[0]


def _slopes(inverse: jax.Array, slopes: tuple[jax.Array, jax.Array]) -> tuple[jax.Array]:
    """Return the derivatives with respect to A, given those with respect to both values."""
    of_inverse, of_log_det = slopes

    # d log det A = tr(A^-1 dA) and d A^-1 = -A^-1 dA A^-1 (Petersen, Pedersen 2012, 2.1-2.2).
    return (of_log_det[..., None, None] * inverse - inverse @ of_inverse @ inverse,)


inverse_and_log_det.defvjp(_with_inverse, _slopes)


@partial(jax.jit, static_argnums=1)
def call(prior: Any, method: str, x: jax.Array) -> jax.Array:
    """Call a method of a distribution as one compiled program instead of one per operation."""
    return getattr(prior, method)(x)


@contextmanager
def own_settings() -> Iterator[None]:
    """Use float64 and the threefry generator, regardless of the caller's JAX flags."""
    with (
        jax.enable_x64(True),
        jax.default_prng_impl("threefry2x32"),
        jax.threefry_partitionable(True),
        jax.numpy_rank_promotion("allow"),
        jax.numpy_dtype_promotion("standard"),
        jax.transfer_guard("allow"),
    ):
        yield
