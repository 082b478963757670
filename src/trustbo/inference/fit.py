"""Fit a model to missions: sample, check the diagnostics, and build a DataTree for ArviZ."""

import json
import time
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any

import numpy as np
import xarray as xr

from trustbo.data import Mission
from trustbo.display import slow_bar
from trustbo.errors import (
    PosteriorError,
    TrustboError,
    require_choice,
    require_count,
    require_kind,
    require_whole,
)
from trustbo.inference.density import Coefficients, Density, JointDraws
from trustbo.inference.draws import as_fitted, names_in, require_fitted
from trustbo.inference.functions.fit import (
    fit_function,
    require_poolable_with_function,
    with_latent_of_function,
)
from trustbo.inference.functions.function import as_model
from trustbo.inference.functions.sampling import AUTO
from trustbo.inference.functions.sampling import SAMPLERS as OF_FUNCTIONS
from trustbo.inference.importance import (
    MAX_KHAT,
    Points,
    Student,
    sample,
)
from trustbo.inference.nuts import sample_by_nuts
from trustbo.inference.place_maps import place_group
from trustbo.inference.tree import (
    N_PRIOR,
    default_draws,
    in_label_order,
    to_datatree,
    with_latent,
)
from trustbo.inference.variables import draws_of, prior_parameters, to_variables
from trustbo.models.backend import library_attrs
from trustbo.models.default import default_model
from trustbo.models.model import TrustModel
from trustbo.models.people import HumanTrust
from trustbo.models.record import model_to_record
from trustbo.models.visited import has_places
from trustbo.parallel import computing
from trustbo.stacking import list_of_missions, prepare, require_same_robots
from trustbo.workspace import Workspace

SAMPLERS = ("importance", "nuts")
"""Names of the samplers of `fit`."""
_NEGLIGIBLE = 0.01
"""Weight of a point, relative to the mean weight, below which EP is not corrected there."""
_SIZE = 256
"""Points per round of the importance sampler."""
_LAST_SIZE = 1024
"""Points per round of the last attempt."""
_MANY_SCORES = 12
"""Smallest number of scores for which a round has four times as many points."""


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
            `"importance"` for model classes. A function is sampled by `"importance"` with adapted
            mixtures, by `"nuts"`, or by `"auto"`, the default: importance sampling and, where its
            checks fail, NUTS.
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
            means k-hat > 0.7; for NUTS, R-hat > 1.01, bulk ESS < 400 or any divergence.
        latent: Whether to add latent trust, log-likelihoods and predictions, as `add_latent` does.
        start: Posterior of the same model given similar data, such as all missions but the last.
            Importance sampling then begins with the proposal of this posterior instead of a search
            for the mode.

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
            leaves the workspace; or a number of draws or the seed is not a whole number.
        PosteriorError: If `check` is true and the diagnostics are bad.

    Example:
        >>> posterior = tb.fit(missions, tb.models.PooledTrust())
        >>> az.summary(posterior)
    """
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

    add_latent: Callable[[xr.DataTree], xr.DataTree]
    if isinstance(model, TrustModel | type) or not callable(model):
        remedy = "give a model such as PooledTrust(), or a NumPyro function"
        trust_model: TrustModel = require_kind("model", model, TrustModel, remedy)
        require_poolable_with_model(trust_model, earlier, robots)
        sampler = SAMPLERS[0] if sampler is None else require_choice("sampler", sampler, SAMPLERS)
        if draws is None:
            draws = default_draws(trust_model.effects, sampler)
        tree, complaints, add_latent = _fit_model(
            missions, trust_model, sampler, workspace, draws, chains, warmup, seed, progress, start
        )
    else:
        function = as_model(model)
        require_poolable_with_function(function, earlier, robots)
        sampler = AUTO if sampler is None else require_choice("sampler", sampler, OF_FUNCTIONS)
        if start is not None:
            start = as_fitted("start", start)  # its draws are read by position
        tree, complaints = fit_function(
            missions,
            function,
            workspace,
            sampler,
            draws,
            chains,
            warmup,
            seed,
            progress,
            check,
            start,
        )
        add_latent = partial(
            with_latent_of_function,
            missions=missions,
            model=function,
            progress=progress,
        )

    if check and complaints:
        raise PosteriorError(
            f"the sampler's diagnostics are bad: {'; '.join(complaints)}.",
            tree,
            "Give more missions, use narrower priors or, for NUTS, increase draws and warmup. To "
            "get the posterior anyway, pass check=False.",
        )

    if latent:
        tree = add_latent(tree)
    if earlier:
        _label_earlier(tree, len(earlier), missions[0].robots[len(robots) :])
    tree.attrs["seconds"] = time.perf_counter() - started
    return tree


def _same_names(start: xr.DataTree | None, mission: Mission) -> xr.DataTree | None:
    """Return `start`, or None if its scores belong to other names."""
    if start is None:
        return None

    start = require_fitted("start", start)
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


def require_poolable_with_model(
    model: TrustModel, earlier: Sequence[Mission], robots: Sequence[str]
) -> None:
    """Raise TrustboError if a model needs the same robots in all missions and `earlier` has others.

    A robot has no rates in the missions of other robots. Only models in which robots influence each
    other cannot handle such gaps.
    """
    if model.joint and not model.exchangeable:
        require_same_robots(type(model).__name__, earlier, robots)


def _label_earlier(tree: xr.DataTree, n_earlier: int, others: Sequence[str]) -> None:
    """Label the earlier missions -n, ..., -1, and record which robots occur only in them."""
    for group in tree.children.values():
        if "mission" in group.dims:
            n_missions = group.sizes["mission"]
            labels = np.arange(n_missions) - n_earlier
            group.dataset = group.to_dataset().assign_coords(mission=labels)
    if others:
        tree.attrs["other_robots"] = list(others)


def _fit_model(
    missions: Sequence[Mission],
    model: TrustModel,
    sampler: str,
    workspace: Workspace | None,
    draws: int,
    chains: int,
    warmup: int | None,
    seed: int,
    progress: bool,
    start: xr.DataTree | None,
) -> tuple[xr.DataTree, list[str], Callable[[xr.DataTree], xr.DataTree]]:
    """Fit a model class; return the posterior, failed checks and a function like `add_latent`."""
    model = model.for_features(missions[0].features)
    density = Density(model, model.observations(missions, workspace))
    if sampler == "importance":
        draws = chains * draws
        chains = 1  # independent draws belong to one chain
        first = _first_proposal(start, model)
        with slow_bar("fit", " points", progress) as bar:
            density.evaluated = bar.update
            drawn, stats, summary = by_importance(density, draws, seed, first)

        complaints = []
        if not summary["k_hat"] <= MAX_KHAT:
            reason = f"k-hat {summary['k_hat']:.2f}, limit {MAX_KHAT}"
            complaints.append(f"importance weights are uneven ({reason})")
    else:
        drawn, stats, summary, complaints = sample_by_nuts(
            density, chains=chains, draws=draws, warmup=warmup, seed=seed, progress=progress
        )

    variables = to_variables(density, drawn)
    tree = _laid_out(density, variables, stats, (chains, draws), missions, seed)
    if "proposal" in summary:
        tree["sample_stats"].attrs["proposal"] = summary.pop("proposal")
    tree.attrs |= _record(model, density) | summary | {"sampler": sampler, "seed": seed}
    tree.attrs |= {"robots": list(missions[0].robots), "features": list(missions[0].features)}
    tree.attrs |= library_attrs(sampler)

    def add_latent(posterior: xr.DataTree) -> xr.DataTree:
        as_read = draws_of(density, variables)  # equal to what `add_latent` reads from a file
        return with_latent(posterior, missions, density, as_read, progress=progress)

    return tree, complaints, add_latent


def by_importance(
    density: Density, n: int, seed: int, first: Student | None = None
) -> tuple[JointDraws, dict[str, np.ndarray], dict[str, Any]]:
    """Take n draws by importance sampling; return the draws, statistics (draw,) and a summary.

    `first` is the first proposal. By default, or if its weights are uneven, the first proposal is
    found by a search for the mode.
    """
    rng = np.random.default_rng(seed)
    attempts = [(_SIZE, None), (_LAST_SIZE, None)]
    if first:
        attempts = [(_SIZE, first), *attempts]
    while True:
        size, proposal = attempts.pop(0)
        if density.n_scores >= _MANY_SCORES:
            size = 4 * size

        drawn, log_p, summary = _draws(density, n, size, rng, proposal)
        if summary["k_hat"] <= MAX_KHAT or not attempts:
            return drawn, {"lp": log_p}, summary


def _draws(
    density: Density,
    n: int,
    size: int,
    rng: np.random.Generator,
    first: Student | None,
) -> tuple[JointDraws, np.ndarray, dict[str, Any]]:
    """Take n draws, beginning with the proposal `first` or with a search for the mode."""
    if first is None:
        start = density.start()
    else:
        start = first.center
        density.run_ep(density.theta(start[None]))

    visited: list[Coefficients] = []

    def visit(z: np.ndarray) -> np.ndarray:
        log_p, coefficients = density.visit(z, rng)
        visited.append(coefficients)
        return log_p

    points = sample(
        density.log_density, start[None], rng,
        size=size, defensive=density.defensive, first=first, visit=visit,
    )  # fmt: skip
    coefficients = Coefficients.joined(visited)
    proposal = points.proposal.text

    if density.exact:
        chosen = points.resample(n, rng)
        c = coefficients.draw(chosen, rng)
    else:
        points, c = _corrected(density, points, coefficients, rng)
        chosen = points.resample(n, rng)
        c = c[chosen]

    summary = {name: getattr(points, name) for name in ("k_hat", "kish", "log_evidence")}
    drawn = JointDraws(density.theta(points.z[chosen]), c)
    return drawn, points.log_p[chosen], summary | {"proposal": proposal}


def _corrected(
    density: Density, points: Points, coefficients: Coefficients, rng: np.random.Generator
) -> tuple[Points, np.ndarray]:
    """Draw coefficients (point, column) at all points, and correct the weights for errors of EP."""
    c, log_q = coefficients.propose(np.arange(len(points.z)), rng)

    some = np.flatnonzero(points.weight * len(points.z) > _NEGLIGIBLE)
    log_ratio = points.log_ratio.copy()
    log_ratio[some] += density.log_joint(points.z[some], c[some], rng)
    log_ratio[some] -= log_q[some] + points.log_p[some]
    return Points.from_log_weights(points.z, points.log_p, log_ratio, points.near), c


def _first_proposal(start: xr.DataTree | None, model: TrustModel) -> Student | None:
    """Return the proposal of a posterior of the same model, or None if there is none."""
    if start is None or start.attrs["model_record"] != json.dumps(model_to_record(model)):
        return None

    text = start["sample_stats"].attrs.get("proposal")
    return None if text is None else Student.from_text(text)


def _laid_out(
    density: Density,
    variables: dict[str, dict[str, np.ndarray]],
    stats: dict[str, np.ndarray],
    shape: tuple[int, int],
    missions: Sequence[Mission],
    seed: int,
) -> xr.DataTree:
    """Build a DataTree from the data, and from posterior and prior draws."""
    rng = np.random.default_rng([seed, 3])
    groups = variables | {"sample_stats": stats}
    groups = {
        group: {name: v.reshape(*shape, *v.shape[1:]) for name, v in values.items()}
        for group, values in groups.items()
    }
    places = groups.pop("places", None)  # has its own axes

    prior_draws = prior_parameters(density, N_PRIOR, rng)
    groups["prior"] = {name: values[None] for name, values in prior_draws.items()}

    dims = in_label_order(groups, density.model.dims)
    tree = to_datatree(groups, missions, dims, density.model.effects)
    if places is not None:
        at: Any = density.observations.visited
        tree["places"] = xr.DataTree(place_group(places, at, missions[0].robots, seed))
    return tree


def _record(model: TrustModel, density: Density) -> dict[str, Any]:
    """Make the attributes that describe the model and the data of a posterior."""
    observations = density.observations
    options = {name: int(v) if isinstance(v, bool) else v for name, v in model.options().items()}
    return {
        "model": type(model).__name__,
        **options,
        "model_record": json.dumps(model_to_record(model)),
        "n_robots": observations.n_robots,
        "n_missions": observations.n_missions,
        **model.x0,
        "resolution": observations.resolution if model.likelihood.adds_noise else 0.0,
        **{f"prior_{name}": text for name, text in model.priors.describe().items()},
    }
