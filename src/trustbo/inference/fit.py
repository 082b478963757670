"""Fit a model to missions: sample, check the diagnostics, and build a DataTree for ArviZ."""

import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
import xarray as xr

from trustbo.data import Mission
from trustbo.errors import (
    PosteriorError,
    TrustboError,
    require_choice,
    require_count,
    require_switch,
    require_whole,
)
from trustbo.inference.learner import as_learner
from trustbo.inference.options import Options
from trustbo.inference.order import as_fitted
from trustbo.inference.posterior import names_in
from trustbo.inference.tree import to_tree, with_latent
from trustbo.models.default import default_model
from trustbo.models.model import TrustModel
from trustbo.models.people import HumanTrust
from trustbo.models.visited import has_places
from trustbo.parallel import computing
from trustbo.stacking import list_of_missions, prepare
from trustbo.workspace import Workspace


@computing()
def fit(
    missions: Iterable[Mission],
    model: TrustModel | Callable[..., Any] | None = None,
    *,
    earlier: Iterable[Mission] = (),
    sampler: str | None = None,
    workspace: Workspace | None = None,
    draws: int | None = None,
    chains: int = 4,
    warmup: int | None = None,
    seed: int = 0,
    progress: bool = True,
    check: bool = True,
    latent: bool = True,
    start: xr.DataTree | None = None,
) -> xr.DataTree:
    """Fit a trust model to missions, and return the posterior of parameters and latent trust.

    This is Bayes' rule, equation (5) of Zheng et al. (2021, arXiv:2201.01878), with latent trust
    integrated out where this is possible, and drawn afterwards. Importance weights are
    Pareto-smoothed (PSIS; Vehtari et al. 2024, Journal of Machine Learning Research 25(72)), and
    k-hat is the diagnostic of that paper.

    Args:
        missions: Missions of one team; NaN marks contact rates that were not measured.
        model: Trust model, or a NumPyro function `model(awareness, contact_rate=None)` (see
            `models.ContactRate` and the how-to "Your own model"). The default is
            `models.default_model()` with place and robot effects; place effects are omitted if a
            mission has no map or a path jumps. For reports of people (see `logs.read_reports`), the
            default is `HumanTrust` with the scale of the reports.
        earlier: Missions of earlier campaigns. They are data like `missions` and precede them, but
            are not changed to match the workspace. Their robots are matched by name, and may
            include robots that are not in `missions`. Their places are those of the workspace only
            if `Mission.map` is "".
        sampler: `"importance"` takes independent draws by adaptive importance sampling. It needs no
            compilation, and integrates out all variables except hyperparameters. `"nuts"` uses
            NumPyro's NUTS, which also samples trust unless rates are Gaussian. The default is
            `"importance"` for model classes. A function is sampled by `"importance"` in two runs
            that must agree, by `"nuts"`, or by `"auto"`, the default: importance sampling and,
            where its checks fail and the function has no effects, NUTS.
        workspace: Workspace of the missions. If given, features and robots are reordered to match
            the workspace, missing awareness such as line of sight is filled in (see
            `Workspace.fill`), and place effects cover the whole grid. Missions over cells without
            awareness are then left out, with a warning. Without a workspace, the grid of place
            effects ends at the last row and column visited.
        draws: Number of draws per chain. The default is 1000, or 250 for importance sampling with
            place effects, whose draws are large.
        chains: Number of NUTS chains. Importance sampling returns the same total number of draws in
            one chain, because its draws are independent of each other.
        warmup: Number of warm-up draws per NUTS chain, which are discarded. The default is 150 for
            Gaussian rates, for which only the step size is tuned, and 300 otherwise.
        seed: Random seed; the same seed gives the same posterior.
        progress: Whether to show a progress bar; importance sampling shows it after 1.5 seconds.
        check: Whether to raise an error if the diagnostics are bad. For importance sampling, this
            means k-hat > 0.7; for NUTS, R-hat > 1.01, bulk ESS < 400 or any divergence. The limits
            for NumPyro functions are different; see the page "Inference".
        latent: Whether to add latent trust, log-likelihoods and predictions, as `add_latent` does.
        start: Posterior of the same model given similar data, such as all missions but the last.
            Importance sampling then begins with the proposal of this posterior instead of a search
            for the mode. The search follows if this posterior turns out to be far away.

    Returns:
        An ArviZ DataTree. `posterior` contains the parameters (for `PooledTrust`, these are beta0,
        beta[feature], b, delta_w and delta_v), and each effect has a separate group. `latent`
        contains trust[chain, draw, mission, bound, robot], and its mean trust_mean and standard
        deviation trust_sd over all draws. `log_likelihood` contains contact_rate[chain, draw,
        mission], so that LOO leaves out whole missions. If all rates have n_ticks, the
        log-likelihoods refer to tick counts (see the attribute `log_likelihood_of`) and are
        comparable between observation families. Other groups are `posterior_predictive`, `prior`,
        `prior_predictive`, `log_prior`, `sample_stats`, `observed_data` and `constant_data`. Bounds
        are labelled from 1, and short missions are padded with NaN.

    Raises:
        TrustboError: If there are no missions; robots or features differ between missions; an
            awareness value is NaN; the sampler is unknown; no contact rate was measured; a path
            leaves the workspace; or a number of draws or the seed is not a whole number. Also if a
            NumPyro function breaks a rule of the how-to "Your own model": for example, if its site
            `contact_rate` is missing, not observed or not a `ContactRate`, if the drift has another
            shape than (mission, bound, robot), or if values depend on padding.
        PosteriorError: If `check` is true and the diagnostics are bad.

    Example:
        >>> posterior = tb.fit(missions, tb.models.PooledTrust())
        >>> az.summary(posterior)
    """
    require_switch("progress", progress)
    require_switch("check", check)
    require_switch("latent", latent)
    started = time.perf_counter()
    earlier = list_of_missions(earlier, "earlier")
    missions, robots = prepare(missions, workspace, earlier)
    start = _same_names(start, missions[0])
    if model is None:
        scale = missions[0].scale  # empty unless the missions are people's reports
        model = HumanTrust(scale=scale) if scale else default_model(places=has_places(missions))
    draws, chains, warmup = require_numbers_of_draws(draws, chains, warmup)
    seed = require_whole("seed", seed, 0)
    if all(np.isnan(mission.contact_rate).all() for mission in missions):
        raise TrustboError("every contact rate is NaN; fit needs at least one measured rate.")

    learner = as_learner(model)
    samplers = learner.samplers
    sampler = samplers[0] if sampler is None else require_choice("sampler", sampler, samplers)
    learner.require_poolable(earlier, robots)
    options = Options(sampler, draws, chains, warmup, seed, progress, check, start)
    found = learner.sampled(missions, workspace, options)

    tree = to_tree(found, missions, seed)
    if check and found.complaints:
        raise PosteriorError(
            f"the sampler's diagnostics are bad: {'; '.join(found.complaints)}.",
            tree,
            "Give more missions, use narrower priors or, for NUTS, increase draws and warmup. To "
            "get the posterior anyway, pass check=False.",
        )

    if latent:
        tree = with_latent(tree, missions, found.source(tree), progress=progress)
    if earlier:
        _label_earlier(tree, len(earlier), missions[0].robots[len(robots) :])
    tree.attrs["seconds"] = time.perf_counter() - started
    return tree


def _same_names(start: xr.DataTree | None, mission: Mission) -> xr.DataTree | None:
    """Return `start`, or None if its scores belong to other names."""
    if start is None:
        return None

    start = as_fitted("start", start)  # draws of a function are read by position
    same_robots = names_in(start, "robot") in ((), mission.robots)
    same_features = names_in(start, "feature") in ((), mission.features)
    return start if same_robots and same_features else None


def require_numbers_of_draws(
    draws: int | None, chains: int, warmup: int | None
) -> tuple[int | None, int, int | None]:
    """Return these arguments of `fit` as ints; raises TrustboError unless each is at least 1."""
    if draws is not None:
        draws = require_count("draws", draws)
    if warmup is not None:
        warmup = require_count("warmup", warmup)
    return draws, require_count("chains", chains), warmup


def _label_earlier(tree: xr.DataTree, n_earlier: int, others: Sequence[str]) -> None:
    """Label the earlier missions -n, ..., -1, and record which robots occur only in them."""
    for group in tree.children.values():
        if "mission" in group.dims:
            n_missions = group.sizes["mission"]
            labels = np.arange(n_missions) - n_earlier
            group.dataset = group.to_dataset().assign_coords(mission=labels)
    if others:
        tree.attrs["other_robots"] = list(others)
