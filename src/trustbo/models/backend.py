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
from pathlib import Path
from threading import Lock
from typing import Any

import jax
import jaxlib.version
from jax.experimental.compilation_cache import compilation_cache
from scipy import special

from trustbo.compiled import folder_of
from trustbo.errors import TrustboError
from trustbo.forks import require_threads_of_jax

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

_SAFE = 0, 11
"""First jaxlib whose programs are stored.

Earlier ones crash when they load programs (before 0.10, uwplasma/vmex#142 and #347), or refuse
programs that the same processor compiled (0.10, jax-ml/jax#38445).
"""
_MOST_BYTES = 1_000_000_000
"""Size of the stored programs beyond which JAX deletes those that were not used for longest."""


def special_functions(x: Any) -> Any:
    """Return `jax.scipy.special` for a JAX array, otherwise `scipy.special`."""
    return jax.scipy.special if isinstance(x, jax.Array) else special


@partial(jax.jit, static_argnums=1)
def call(prior: Any, method: str, x: jax.Array) -> jax.Array:
    """Call a method of a distribution as one compiled program instead of one per operation."""
    return getattr(prior, method)(x)


class _Storage:
    """Storage of programs in the folder of compiled code, while a thread computes with JAX.

    JAX has one cache for all threads, which has no context manager of its own. Afterwards, JAX is
    as it was, so that a user's own programs are not stored. If the user has set up JAX's cache, or
    has switched it off, nothing changes.
    """

    def __init__(self) -> None:
        self._lock = Lock()
        self._n_inside = 0
        self._before: dict[str, Any] = {}

    def enter(self) -> None:
        """Set up JAX's cache if no other thread is inside."""
        with self._lock:
            if self._n_inside == 0 and jax.config.jax_enable_compilation_cache:
                folder = None if jax.config.jax_compilation_cache_dir else _folder()
                if folder is not None:
                    self._set_up(str(folder))
            self._n_inside += 1

    def _set_up(self, folder: str) -> None:
        settings = {
            "jax_compilation_cache_dir": folder,
            "jax_compilation_cache_max_size": _MOST_BYTES,  # also makes processes take turns
            "jax_persistent_cache_min_compile_time_secs": 0.0,
        }
        for name, value in settings.items():
            self._before[name] = getattr(jax.config, name)
            jax.config.update(name, value)

    def leave(self) -> None:
        """Restore JAX's settings if no other thread is inside."""
        with self._lock:
            self._n_inside -= 1
            if self._n_inside == 0 and self._before:
                for name, value in self._before.items():
                    jax.config.update(name, value)
                self._before = {}
                compilation_cache.reset_cache()  # it keeps the folder of its first use otherwise


_STORAGE = _Storage()


def _folder() -> Path | None:
    """Return the folder of compiled programs, or None where they cannot be stored."""
    # Metadata of packages can be stale, so the version is that of the module in use.
    runtime = jaxlib.version.__version__
    if tuple(int(part) for part in runtime.split(".")[:2]) < _SAFE:
        return None
    return folder_of("jax", f"jax {jax.__version__}, jaxlib {runtime}")


@contextmanager
def own_settings() -> Iterator[None]:
    """Context of all computations with JAX; see `own_flags`.

    Programs that are compiled inside are stored on disk; see `compiled`. Raises TrustboError in a
    forked process, in which JAX would hang.
    """
    require_threads_of_jax()
    _STORAGE.enter()
    try:
        with own_flags():
            yield
    finally:
        _STORAGE.leave()


@contextmanager
def own_flags() -> Iterator[None]:
    """Use float64 and the threefry generator, regardless of the caller's JAX flags.

    Nor do flags apply with which users look for errors in their own programs: our programs contain
    NaN and infinities that are masked later, as do those of NumPyro.

    This alone is enough to make a distribution that computes nothing, such as a normal one.
    """
    with (
        _naming_the_device(),
        jax.enable_x64(True),
        jax.default_prng_impl("threefry2x32"),
        jax.enable_custom_prng(False),
        jax.debug_nans(False),
        jax.debug_infs(False),
        jax.disable_jit(False),
        jax.check_tracer_leaks(False),
        jax.debug_key_reuse(False),
        jax.threefry_partitionable(True),
        jax.numpy_rank_promotion("allow"),
        jax.numpy_dtype_promotion("standard"),
        jax.transfer_guard("allow"),
    ):
        yield


@contextmanager
def _naming_the_device() -> Iterator[None]:
    """Raise a TrustboError with JAX's reason if the block fails because JAX has no device.

    JAX is asked only after an error, as the question starts its threads.
    """
    try:
        yield
    except (RuntimeError, AssertionError):
        try:
            jax.devices()
        except (RuntimeError, AssertionError) as error:
            reason = " ".join(str(error).split()) or "no platform could be initialised"
            raise TrustboError(
                f"JAX has no device for jax_platforms={jax.config.jax_platforms!r}: "
                f"{reason.rstrip('.')}. Unset JAX_PLATFORMS, or set JAX_PLATFORMS=cpu."
            ) from error
        raise
