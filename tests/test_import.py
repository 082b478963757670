"""What importing trustbo costs and touches."""

import ast
import re
import subprocess
import sys
import tomllib
from importlib import import_module, resources
from pathlib import Path

import pytest

import trustbo

ROOT = Path(__file__).resolve().parents[1]
PARTS = ("export", "hazard", "logs", "models", "planning", "plots", "report", "simulation", "study",
         "terrain", "workspace")  # fmt: skip


def printed(program):
    """What it prints in a fresh process."""
    command = [sys.executable, "-c", program]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


@pytest.fixture(scope="module")
def loaded():
    """Modules that a fresh process has loaded after each of three imports."""
    program = (
        "import sys\n"
        "for step in ('import trustbo', 'trustbo.Mission', 'import trustbo.inference'):\n"
        "    exec(step)\n"
        "    print(*sys.modules)\n"
    )
    return [set(line.split()) for line in printed(program).splitlines()]


def test_importing_loads_nothing_heavy(loaded):
    heavy = {"jax", "numpyro", "rasterio", "matplotlib", "networkx", "bokeh", "xarray"}
    assert "trustbo" in loaded[0]
    assert not heavy & loaded[0]


def test_data_of_missions_load_no_compiler(loaded):
    assert "trustbo.data" in loaded[1]
    assert "numba" not in loaded[1]


def test_fitting_loads_no_figures(loaded):
    assert "trustbo.inference" in loaded[2]
    assert not {"arviz", "arviz_plots", "matplotlib"} & loaded[2]


def test_type_checkers_are_told_that_it_is_typed():
    assert resources.files("trustbo").joinpath("py.typed").is_file()
    assert resources.files("trustbo").joinpath("templates", "report.html").is_file()
    build = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"]
    assert build["targets"]["wheel"] == {"packages": ["src/trustbo"]}  # all files in it


def test_every_public_name_is_there():
    for name in trustbo.__all__:
        assert getattr(trustbo, name) is not None
    assert re.fullmatch(r"\d+\.\d+\.\d+(\.dev\d+)?", trustbo.__version__)


@pytest.mark.parametrize(
    "name",
    [
        "workspace.MOVES",
        "hazard.fit_hazard",
        "hazard.BoundRisk",
        "hazard.CAUSES",
        "models.TrustParams",
        "models.Effect",
        "simulation.Event",
    ],
)
def test_names_that_docstrings_cite_are_public(name):
    package, name = name.split(".")
    assert name in getattr(trustbo, package).__all__
    assert getattr(getattr(trustbo, package), name) is not None


def test_a_kernel_without_ipywidgets_is_not_warned_of_progress_bars():
    program = (
        "import sys, warnings\n"
        "import ipykernel.zmqshell\n"  # as in a kernel of Jupyter
        "sys.modules['ipywidgets'] = None\n"
        "with warnings.catch_warnings(record=True) as said:\n"
        "    warnings.simplefilter('always')\n"
        "    import trustbo.models, trustbo.campaign\n"
        "    import numpyro.util\n"
        "print([str(w.message) for w in said if 'IProgress' in str(w.message)])\n"
        "import tqdm.auto\n"
        "print('tqdm.autonotebook' in sys.modules)\n"
    )
    assert printed(program) == "[]\nTrue"


# Nothing before it is how all other processes of these tests import it.
@pytest.mark.slow  # processes start for long
@pytest.mark.parametrize(
    ("before", "used"),
    [
        # In these two, numpyro has lost `distributions.distribution` before trustbo loads it.
        ("import arviz", "numpyro.distributions.Unit"),
        ("import arviz, numpyro.distributions", "numpyro.distributions.Unit"),
        ("import arviz; import trustbo.models", "numpyro.distributions.distribution.Unit"),
        ("import numpyro, arviz", "numpyro.distributions.distribution.Unit"),
    ],
)
def test_numpyro_works_whatever_was_imported_first(before, used):
    """arviz_base leaves it half loaded; and JAX's configuration is as it was."""
    program = (
        f"{before}\n"
        "import trustbo as tb\n"
        "import numpyro.distributions as dist\n"
        "from numpyro import handlers\n"
        "import jax, numpy as np, trustbo.models, trustbo.campaign\n"
        "print(jax.config.jax_enable_x64, jax.numpy.ones(()).dtype)\n"
        "model = tb.models.PooledTrust(tb.models.Priors(beta0=dist.Beta(2.0, 3.0)))\n"
        "program = handlers.seed(model.program, jax.random.key(0))\n"
        "path = [(0, 0), (0, 1), (0, 2), (0, 3)]\n"
        "z = np.full((3, 2, 2), 0.5)\n"
        "observations = model.observations([tb.Mission.from_arrays(path, z, z[..., 0])])\n"
        "print(handlers.trace(program).get_trace(observations)['contact_rate']['value'].shape)\n"
        "import numpyro.infer\n"
        "draw = numpyro.infer.Predictive(model.program, num_samples=4)\n"
        "print(draw(jax.random.key(0), observations)['contact_rate'].shape)\n"
        f"numpyro.factor, {used}\n"
    )
    assert printed(program) == "False float32\n(1, 3, 2)\n(4, 1, 3, 2)"


@pytest.mark.slow  # processes start for long
def test_modules_of_numpyro_are_left_as_they_are():
    """Even where they lack their submodules, which makes a write to them visible."""
    program = (
        "import arviz, numpyro.distributions\n"
        "import sys\n"
        "numpyro.factor\n"
        "before = {n: {*vars(m)} for n, m in sys.modules.items() if n.startswith('numpyro')}\n"
        "import trustbo.models, trustbo.campaign\n"
        "added = {n: {*vars(sys.modules[n])} - names for n, names in before.items()}\n"
        "print({n: names for n, names in added.items() if names})\n"
    )
    assert printed(program) == "{}"


@pytest.mark.parametrize("name", ["trustbo", *(f"trustbo.{part}" for part in PARTS)])
def test_completion_lists_public_names_alone(name):
    module = import_module(name)
    for public in module.__all__:
        assert getattr(module, public) is not None  # loads what is loaded lazily
    assert sorted(dir(module)) == sorted(module.__all__)


def test_a_name_that_never_was_is_refused():
    with pytest.raises(AttributeError, match=r"'trustbo\.models' has no attribute 'nothing'"):
        trustbo.models.nothing  # noqa: B018


def test_a_missing_package_is_named_itself_and_is_one_of_an_extra():
    """pip finds `trustbo[ros]` only where trustbo is on an index."""
    sources = [file.read_text() for file in (ROOT / "src" / "trustbo").rglob("*.py")]
    assert [text for text in sources if re.search(r"pip install \S*trustbo\[", text)] == []
    named = set(re.findall(r"pip install '?([\w-]+)", "".join(sources)))
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    offered = {
        re.match(r"[\w-]+", requirement)[0]
        for packages in extras["optional-dependencies"].values()
        for requirement in packages
    }
    assert named >= {"rosbags", "laspy"}
    assert named <= offered


def imported_names():
    """All modules, as `a.b.c`, that the package imports from elsewhere."""
    for file in (ROOT / "src" / "trustbo").rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.Import):
                yield from (alias.name for alias in node.names)
            elif isinstance(node, ast.ImportFrom) and node.module:
                yield from (f"{node.module}.{alias.name}" for alias in node.names)


def test_no_private_module_of_another_package_is_imported():
    private = re.compile(r"\._(?!_)")
    assert [name for name in imported_names() if private.search(name)] == []


def test_every_imported_package_is_declared():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    required = [project["dependencies"], *project["optional-dependencies"].values()]
    declared = {re.match(r"[\w-]+", each)[0].lower() for part in required for each in part}
    declared |= {name.replace("-", "_") for name in declared}

    packages = {name.partition(".")[0] for name in imported_names()}
    assert packages - {*sys.stdlib_module_names, "trustbo"} - declared == set()


def test_helpers_of_tests_are_not_in_test_files():
    """They are in modules such as missions.py and worlds.py, also for programs that tests start."""
    imported = re.compile(r"^\s*(?:from|import) +(?:\w+\.)*(?:test_\w+|conftest)\b", re.MULTILINE)
    guilty = {
        str(path.relative_to(ROOT)): found
        for path in (ROOT / "tests").rglob("*.py")
        if (found := imported.findall(path.read_text()))
    }
    assert not guilty
