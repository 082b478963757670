"""Fit a model to missions: sample, check the diagnostics, and build a DataTree for ArviZ."""

import json
import time
from collections.abc import Callable, Iterable, Sequence
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
from trustbo.inference.classes import OfClass
from trustbo.inference.density import Coefficients, Density, JointDraws
from trustbo.inference.draws import as_fitted, names_in, stored_draws
from trustbo.inference.functions.fit import fit_function, require_poolable_with_function
from trustbo.inference.functions.known import as_model
from trustbo.inference.functions.sampling import SAMPLERS as OF_FUNCTIONS
from trustbo.inference.importance import MAX_KHAT, Points, Student, sample
from trustbo.inference.latent import N_PRIOR
from trustbo.inference.nuts import sample_by_nuts
from trustbo.inference.options import Options
from trustbo.inference.tree import Fitted, by_chain, default_draws, to_tree, with_latent
from trustbo.inference.variables import prior_parameters, to_variables
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
_MANY_SCORES = 13
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

    is_class = isinstance(model, TrustModel | type) or not callable(model)
    samplers = SAMPLERS if is_class else OF_FUNCTIONS
    sampler = samplers[0] if sampler is None else require_choice("sampler", sampler, samplers)
    options = Options(sampler, draws, chains, warmup, seed, progress, check, start)
    if is_class:
        remedy = "give a model such as PooledTrust(), or a NumPyro function"
        of_class: TrustModel = require_kind("model", model, TrustModel, remedy)
        require_poolable_with_model(of_class, earlier, robots)
        found = fit_class(missions, of_class, workspace, options)
    else:
        function = as_model(model)  # pyright: ignore[reportArgumentType]
        require_poolable_with_function(function, earlier, robots)
        found = fit_function(missions, function, workspace, options)

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


def fit_class(
    missions: Sequence[Mission],
    model: TrustModel,
    workspace: Workspace | None,
    options: Options,
) -> Fitted:
    """Fit a model class to missions."""
    model = model.for_features(missions[0].features)
    density = Density(model, model.observations(missions, workspace))
    record = json.dumps(model_to_record(model))
    draws = options.draws or default_draws(model.effects, options.sampler)
    if options.sampler == "importance":
        first = _first_proposal(options.start, record)
        with slow_bar("fit", " points", options.progress) as bar:
            density.evaluated = bar.update
            drawn, stats, summary = by_importance(
                density, options.chains * draws, options.seed, first
            )

        stats = {name: values[None] for name, values in stats.items()}  # in one chain
        notes = {"sample_stats": {"proposal": summary.pop("proposal")}}
        complaints = []
        if not summary["k_hat"] <= MAX_KHAT:
            reason = f"k-hat {summary['k_hat']:.2f}, limit {MAX_KHAT}"
            complaints.append(f"importance weights are uneven ({reason})")
    else:
        drawn, stats, summary, complaints = sample_by_nuts(
            density,
            chains=options.chains,
            draws=draws,
            warmup=options.warmup,
            seed=options.seed,
            progress=options.progress,
        )
        stats = by_chain(stats, options.chains)
        notes = {}

    resolution = density.observations.resolution if model.likelihood.adds_noise else 0.0
    return Fitted(
        variables=to_variables(density, drawn),
        prior=prior_parameters(density, N_PRIOR, np.random.default_rng([options.seed, 3])),
        dims=model.dims,
        labels={},
        effects=model.effects,
        observations=density.observations,
        statistics=stats,
        attrs={
            "model": type(model).__name__,
            "model_record": record,
            **_described(model),
            "resolution": resolution,
            "sampler": options.sampler,
            **summary,
        },
        notes=notes,
        by_position=False,
        complaints=complaints,
        source=lambda tree: OfClass(density, stored_draws(density, tree)),
    )


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


def _first_proposal(start: xr.DataTree | None, record: str) -> Student | None:
    """Return the proposal of a posterior of a model with this record, or None."""
    if start is None or start.attrs["model_record"] != record:
        return None

    text = start["sample_stats"].attrs.get("proposal")
    return None if text is None else Student.from_text(text)


def _described(model: TrustModel) -> dict[str, Any]:
    """Return the options and priors of a model as attributes of a posterior."""
    options = {name: int(v) if isinstance(v, bool) else v for name, v in model.options().items()}
    priors = {f"prior_{name}": text for name, text in model.priors.describe().items()}
    return {**options, **model.x0, **priors}
