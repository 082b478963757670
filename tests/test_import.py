"""What importing trustbo costs and touches."""

import subprocess
import sys
import tomllib
from importlib import resources
from pathlib import Path

import pytest

import trustbo


def printed(program):
    """What it prints in a fresh process."""
    command = [sys.executable, "-c", program]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def test_importing_loads_nothing_heavy():
    program = (
        "import sys, trustbo; "
        "print(sorted({'jax', 'numpyro', 'rasterio', 'matplotlib', 'networkx', 'bokeh', "
        "'xarray'} "
        "& set(sys.modules)))"
    )
    assert printed(program) == "[]"


def test_type_checkers_are_told_that_it_is_typed():
    assert resources.files("trustbo").joinpath("py.typed").is_file()
    root = Path(__file__).resolve().parents[1]
    build = tomllib.loads((root / "pyproject.toml").read_text())["tool"]["hatch"]["build"]
    assert build["targets"]["wheel"] == {"packages": ["src/trustbo"]}  # all files in it


def test_every_public_name_is_there():
    for name in trustbo.__all__:
        assert getattr(trustbo, name) is not None
    assert trustbo.__version__.count(".") == 2


# Nothing before it is how all other processes of these tests import it.
@pytest.mark.slow  # processes start for long
@pytest.mark.parametrize(
    "before", ["import arviz", "import arviz, numpyro.distributions", "import numpyro, arviz"]
)
def test_numpyro_works_whatever_was_imported_first(before):
    """arviz_base leaves it half loaded; and JAX's configuration is as it was."""
    program = (
        f"{before}\n"
        "import trustbo as tb\n"
        "import numpyro.distributions as dist\n"
        "from numpyro import handlers\n"
        "import jax, numpy as np, trustbo.models, trustbo.campaign\n"
        "print(jax.config.jax_enable_x64, jax.numpy.ones(()).dtype)\n"
        "model = tb.models.PooledTrust(tb.models.Priors(beta0=dist.Beta(2.0, 3.0)))\n"
        "model = handlers.seed(model, jax.random.key(0))\n"
        "z = np.full((1, 3, 2, 2), 0.5)\n"
        "print(handlers.trace(model).get_trace(z)['contact_rate']['value'].shape)\n"
        "import numpyro; numpyro.factor; numpyro.distributions.distribution.Unit\n"
    )
    assert printed(program) == "False float32\n(1, 3, 2)"
