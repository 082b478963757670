"""Every function of ArviZ runs on a posterior, or the page on ArviZ says that it does not."""

import re
import types
from importlib.metadata import version
from pathlib import Path

import arviz as az
import matplotlib.pyplot as plt
import numpy as np
import pytest
from arviz_base.base import make_attrs

import trustbo as tb
from trustbo.models import PooledTrust

PAGE = Path(__file__).resolve().parents[2] / "docs" / "howto" / "use-arviz.md"
HELPERS = {"add_lines", "add_bands", "get_function"}
"""Functions that take plots or names, not posteriors."""
FEATURES = ("traversability", "line_of_sight")


def likelihood(_, tree):
    return tree["log_likelihood"]["contact_rate"]


def subsampled(tree):
    return az.loo_subsample(
        tree, observations=5, pointwise=True, log_lik_fn=likelihood, method="lpd"
    )


def two(tree):
    return tree["posterior"]["b"], tree["posterior"]["beta0"]


ARGUMENTS = {
    "bayes_factor": lambda tree: az.bayes_factor(tree, var_names=["b"], ref_vals=0.0),
    "bayesian_r2": lambda tree: az.bayesian_r2(tree, "contact_rate", "delta_v"),
    "ci_in_rope": lambda tree: az.ci_in_rope(tree, rope=(0.0, 1.0), var_names=["b"]),
    "combine_plots": lambda tree: az.combine_plots(
        tree, plots=[(az.plot_trace, {}), (az.plot_dist, {})], var_names=["b"]
    ),
    "compare": lambda tree: az.compare({"a": tree, "b": tree}),
    "ecdf": lambda tree: az.ecdf(tree["posterior"].dataset),
    "generate_survival_curves": lambda tree: az.generate_survival_curves(tree, "contact_rate"),
    "hexbin": lambda tree: az.hexbin(*two(tree)),
    "histogram2d": lambda tree: az.histogram2d(*two(tree)),
    "kaplan_meier": lambda tree: az.kaplan_meier(tree, "contact_rate"),
    "kde2d": lambda tree: az.kde2d(*two(tree)),
    "kl_divergence": lambda tree: az.kl_divergence(tree, tree, var_names=["b"]),
    "loo_approximate_posterior": lambda tree: az.loo_approximate_posterior(
        tree, log_p=tree["sample_stats"]["lp"], log_q=tree["sample_stats"]["lp"]
    ),
    "loo_i": lambda tree: az.loo_i(0, tree),
    "loo_moment_match": lambda tree: az.loo_moment_match(tree, az.loo(tree, pointwise=True)),
    "loo_r2": lambda tree: az.loo_r2(tree, var_name="contact_rate"),
    "loo_subsample": subsampled,
    "plot_bf": lambda tree: az.plot_bf(tree, var_names=["b"], ref_val=0.0),
    "plot_compare": lambda tree: az.plot_compare(az.compare({"a": tree, "b": tree})),
    "plot_ecdf_pit": lambda tree: az.plot_ecdf_pit(az.loo_pit(tree), sample_dims=["rate"]),
    "plot_khat": lambda tree: az.plot_khat(az.loo(tree, pointwise=True)),
    "plot_lm": lambda tree: az.plot_lm(tree, x="line_of_sight", y="contact_rate"),
    "plot_pair_focus": lambda tree: az.plot_pair_focus(tree, focus_var="b", var_names=["beta0"]),
    "plot_ppc_pava_residuals": lambda tree: az.plot_ppc_pava_residuals(tree, x_var="line_of_sight"),
    "plot_psense_quantities": lambda tree: az.plot_psense_quantities(
        tree, quantities=["mean"], var_names=["b"]
    ),
    "residual_r2": lambda tree: az.residual_r2(tree, "contact_rate", "contact_rate"),
    "update_subsample": lambda tree: az.update_subsample(
        subsampled(tree), tree, observations=3, log_lik_fn=likelihood, method="lpd"
    ),
    "wasserstein": lambda tree: az.wasserstein(tree, tree, var_names=["b"], num_samples=50),
    "weight_predictions": lambda tree: az.weight_predictions([tree, tree], weights=[0.5, 0.5]),
}
"""Calls of functions that need more than a posterior."""


def functions():
    """Names of the functions of ArviZ that compute or plot."""
    found = []
    for name in dir(az):
        one = getattr(az, name)
        if isinstance(one, types.FunctionType) and name not in HELPERS:
            package, *_ = one.__module__.split(".")
            if package in ("arviz_stats", "arviz_plots"):
                found.append(name)
    return found


def table_of(header):
    """The rows of a table of the page: names of functions, and the text of the other cells."""
    rows = PAGE.read_text().split(header)[1].split("\n\n")[0].splitlines()[2:]
    return [
        (re.findall(r"`(\w+)`", row.split("|")[1]), " ".join(row.split("|")[2:])) for row in rows
    ]


BY_RATE = {name for names, _ in table_of("| functions that need `by_rate` |") for name in names}
FAILING = {name: text for names, text in table_of("| function | input |") for name in names}


@pytest.fixture(scope="module")
def missions():
    rng = np.random.default_rng(0)
    missions = []
    for _ in range(8):
        path = [(k, int(rng.integers(2)) + 1) for k in range(7)]
        z = rng.uniform(size=(6, 2, 2))
        rates = np.clip(0.2 + 0.3 * z.sum(-1) + 0.05 * rng.standard_normal((6, 2)), 0.0, 1.0)
        rates[rng.random(rates.shape) < 0.15] = np.nan
        missions.append(tb.Mission.from_arrays(path, z, rates, features=FEATURES))
    return missions


@pytest.fixture(scope="module")
def trees(missions):
    posterior = tb.fit(missions, PooledTrust(), draws=250, progress=False)
    return posterior, tb.inference.by_rate(posterior)


@pytest.fixture(scope="module")
def of_nuts(missions):
    """A single chain."""
    size = {"chains": 1, "draws": 20, "warmup": 20}
    return tb.fit(missions, PooledTrust(), sampler="nuts", progress=False, check=False, **size)


def test_nuts_samples_a_single_chain(of_nuts):
    assert dict(of_nuts["posterior"].sizes)["chain"] == 1
    assert dict(of_nuts["posterior"].sizes)["draw"] == 20


def call(name, tree):
    try:
        ARGUMENTS.get(name, getattr(az, name))(tree)
    finally:
        plt.close("all")


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=pytest.mark.slow if "plot" in n else ()) for n in functions()],
)
def test_a_function_runs_or_the_page_says_where(name, trees, request):
    posterior, rates = trees
    if name not in BY_RATE and name not in FAILING:
        call(name, posterior)
        return

    # What ArviZ raises differs between its functions.
    with pytest.raises(Exception):  # noqa: B017, PT011
        call(name, posterior)
    if name in BY_RATE:
        call(name, rates)
    elif "importance" in FAILING[name]:
        call(name, request.getfixturevalue("of_nuts"))
    else:
        with pytest.raises(Exception):  # noqa: B017, PT011
            call(name, rates)


def test_a_posterior_names_its_libraries_as_arviz_does_but_not_the_time(trees, of_nuts):
    written = set(make_attrs(inference_library=np)) - {"created_at"}
    for tree, library in ((trees[0], "trustbo"), (of_nuts, "numpyro")):
        assert written <= set(tree.attrs)
        assert "created_at" not in tree.attrs
        assert tree.attrs["creation_library"] == "trustbo"
        assert tree.attrs["inference_library"] == library
        assert tree.attrs["inference_library_version"] == version(library)


def test_the_page_names_functions_of_arviz():
    assert set(functions()) >= BY_RATE | set(FAILING)
    assert set(functions()) >= set(ARGUMENTS)
