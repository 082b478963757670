"""numpyro, whole; and the JAX settings that results are computed under.

arviz_base leaves a lazy numpyro in `sys.modules`. Whoever then imports a submodule of it first, as
in `import arviz; import numpyro.distributions`, gets packages that miss their own submodules, and
numpyro fails ("numpyro.distributions has no attribute 'distribution'"). To ask the package for
something first avoids it; where it has happened already, the submodules are put in their places.
"""

import sys
from collections.abc import Iterator
from contextlib import contextmanager

import jax
import numpyro

NUMPYRO_VERSION: str = numpyro.__version__

for _name, _module in list(sys.modules.items()):
    _package, _, _child = _name.rpartition(".")
    if _package.startswith("numpyro") and not hasattr(sys.modules[_package], _child):
        setattr(sys.modules[_package], _child, _module)


@contextmanager
def own_settings() -> Iterator[None]:
    """Compute in float64 with one random number generator, whatever the caller's JAX flags are."""
    with (
        jax.enable_x64(True),
        jax.default_prng_impl("threefry2x32"),
        jax.threefry_partitionable(True),
        jax.numpy_rank_promotion("allow"),
        jax.numpy_dtype_promotion("standard"),
    ):
        yield
