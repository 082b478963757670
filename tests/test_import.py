"""What importing trustbo costs and touches."""

import subprocess
import sys

import trustbo


def test_importing_loads_nothing_heavy():
    program = (
        "import sys, trustbo; "
        "print(sorted({'jax', 'numpyro', 'rasterio', 'matplotlib', 'networkx', 'xarray'} "
        "& set(sys.modules)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"


def test_every_public_name_is_there():
    for name in trustbo.__all__:
        assert getattr(trustbo, name) is not None
    assert trustbo.__version__.count(".") == 2


def test_jax_s_configuration_is_untouched_by_importing():
    program = (
        "import jax, trustbo, trustbo.models, trustbo.loop; "
        "print(jax.config.jax_enable_x64, jax.numpy.ones(()).dtype)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "False float32"
