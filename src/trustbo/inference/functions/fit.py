"""Fit a model that is a NumPyro function, and complete its posterior."""

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
import xarray as xr

from trustbo.data import Mission
from trustbo.display import joined as joined_names
from trustbo.display import slow_bar
from trustbo.errors import TrustboError, require_kind, warn
from trustbo.inference.diagnostics import MAX_RHAT, MIN_ESS, complaints_of, statistics_of
from trustbo.inference.draws import in_order_of, joined_draws, names_in
from trustbo.inference.functions.checks import require_fittable, require_unpadded_results
from trustbo.inference.functions.data import (
    RATES,
    Data,
    arrays_of,
    data_of,
    data_of_bounds,
    data_of_example,
    observations_of,
)
from trustbo.inference.functions.draws import N_CHECKED, FunctionDraws
from trustbo.inference.functions.function import Found, FunctionModel
from trustbo.inference.functions.nuts import (
    Sampler,
    Samples,
    Start,
    cold_start,
    coordinates_of,
    free_shapes,
    joined_samples,
    warm_start,
)
from trustbo.inference.functions.sites import Site, safe
from trustbo.inference.latent import Latent
from trustbo.inference.tree import N_PRIOR, add_groups, kept_draws, to_datatree
from trustbo.models.backend import library_attrs, own_settings
from trustbo.models.families import FAMILIES
from trustbo.models.observations import Observations
from trustbo.stacking import require_same_robots
from trustbo.statespace import kalman
from trustbo.statespace.form import Inputs, StateSpace
from trustbo.streams import stream
from trustbo.workspace import Workspace

_WARMUP = 300
"""Warm-up draws per chain of each run of NUTS, which are discarded."""
_ACCEPT = 0.95
"""Target of the acceptance probability."""
_LAST_ACCEPT = 0.99
"""Target of the acceptance probability after a divergent transition."""
_ATTEMPTS = 4
"""Number of NUTS runs after which bad diagnostics are reported, if each run has many draws."""
_PATIENT = 2
"""Number of runs after which the chains of the drift may be checked instead of the variables'."""
_TOLERATED = 0.005
"""Fraction of divergent transitions that is accepted from then on, with a warning."""
_ROUGH_RHAT = 1.1
"""Largest R-hat of the drift and the noises that the last check accepts, with a warning."""
_ROUGH_ESS = 50.0
"""Smallest bulk ESS of the drift and the noises that the last check accepts."""
_INVENTED = 4
"""Number of bounds of an invented mission, with which a function is checked before missions."""
_CHECKED = 100
"""Largest number of measured bounds whose drift is checked."""
_MOST_ATTEMPTS = 10
"""Largest number of runs, however short."""
_MANY = 4000
"""Total number of draws per chain, over all runs, before bad diagnostics are reported."""
_OF_PRIOR = 2
"""Offset of the seed of the draws in the groups `prior` and `prior_predictive`."""
_SIZE = 200
"""Number of draws for which latent trust is drawn at once."""


def fit_function(
    missions: Sequence[Mission],
    model: FunctionModel,
    workspace: Workspace | None,
    draws: int,
    chains: int,
    warmup: int | None,
    seed: int,
    progress: bool,
    check: bool,
    start: xr.DataTree | None,
) -> tuple[xr.DataTree, list[str]]:
    """Fit a function to missions with NUTS; for the arguments, see `trustbo.fit`.

    If the diagnostics are bad and `check` is true, NUTS is run again; see `_sampled`.

    Returns:
        The posterior of the parameters, and a list of failed checks.

    Raises:
        TrustboError: If the function cannot be a model of these missions.
    """
    warmup = _WARMUP if warmup is None else warmup
    observations = Observations.from_missions(missions)
    data = _data_for(model, missions, observations)
    sites = model.sites(data)
    _sampler(model).require_gradient(data, sites)
    if workspace is not None:
        require_plannable(model, workspace)
    require_fittable(model, data, sites, [len(mission.bounds) for mission in missions])

    first = _start(model, sites, data, start, chains, seed)
    samples, verdict = _sampled(
        model, data, sites, first, warmup, draws, seed=seed, progress=progress, check=check
    )
    stats = statistics_of(samples.fields)

    n_missions = len(missions)
    tree = _tree(model, _constrained(model, data, samples), sites, stats, missions, data, seed)
    tree.attrs |= {
        "model": model.name,
        "model_record": model.text,
        "family": model.family,
        "n_robots": observations.n_robots,
        "n_missions": n_missions,
        "robots": list(missions[0].robots),
        "features": list(missions[0].features),
        "sampler": "nuts",
        "seed": seed,
        "step_size": samples.step_size,
        **verdict.diagnostics,
        "not_identified": verdict.not_identified,
        **library_attrs("nuts"),
    }

    if not verdict.complaints:
        _warn(model, verdict, stats["diverging"].size)
    return tree, verdict.complaints


def _warn(model: FunctionModel, verdict: "Verdict", n_transitions: int) -> None:
    """Warn about diagnostics that were accepted although they exceed the usual limits."""
    n_diverged = int(verdict.diagnostics["divergences"])
    r_hat = verdict.diagnostics["r_hat"]
    ess = verdict.diagnostics["ess_bulk"]
    is_rough = r_hat > MAX_RHAT or ess < MIN_ESS

    if n_diverged:
        warn(
            f"{n_diverged} of {n_transitions} transitions diverged, even with small steps: draws "
            f"of {model.in_short()} may miss narrow parts of the posterior. Narrower priors or "
            "another parametrisation help."
        )
    if is_rough:
        warn(
            f"the posterior of {model.in_short()} is rough: R-hat of its drift and noises is "
            f"{r_hat:.3f}, bulk ESS {ess:.0f}. More draws and warmup, narrower priors or fewer "
            "variables help."
        )
    if verdict.not_identified:
        names = joined_names(verdict.not_identified)
        chains = f"the chains of {names} differ or have too few draws"
        if is_rough:
            text = f"{chains}, even under the wider limits of a rough posterior: do not interpret"
            warn(f"{text} these variables.")
        else:
            warn(
                f"{chains}, but those of the drift and noises agree: plans and predictions can be "
                "used, these variables cannot."
            )


def with_latent_of_function(
    posterior: xr.DataTree,
    missions: Sequence[Mission],
    model: FunctionModel,
    *,
    progress: bool = True,
) -> xr.DataTree:
    """Add latent trust, log-likelihoods and predictions to a posterior of a function."""
    observations = Observations.from_missions(missions)
    data = _data_for(model, missions, observations)
    sites = model.sites(data)
    sizes = posterior["posterior"].sizes
    n_draws = sizes["chain"] * sizes["draw"]
    n_missions = len(missions)
    seed = posterior.attrs["seed"]

    _, some = kept_draws(posterior)
    rng = stream(seed, "latent of a function")

    shape = observations.contact_rate.shape
    mean = np.zeros(shape)
    square = np.zeros(shape)
    log_likelihood = np.empty((n_draws, n_missions))
    log_prior: dict[str, list[np.ndarray]] = {}
    of_counts = True
    trust = np.empty((len(some), *shape))
    predicted = np.empty((len(some), *shape))
    with slow_bar("latent trust", " draws", progress, total=n_draws) as bar:
        for where, found in _evaluated(model, posterior, data, np.arange(n_draws)):
            of_counts = bool(found.of_counts.all())
            log_likelihood[where] = found.log_likelihood[:, :n_missions]
            for name, of_site in found.log_prior.items():
                own = _without_padding(of_site[None], sites[name], n_missions)[0]
                log_prior.setdefault(safe(name), []).append(own.reshape(len(own), -1).sum(1))

            space, inputs = _form_of(found, n_missions, shape[1])
            x = _drawn_trust(space, inputs, observations, rng)
            rates = _replicated(space, inputs, observations, rng)
            mean += x.sum(0) / n_draws
            square += (x**2).sum(0) / n_draws

            begin = where[0]
            first, last = np.searchsorted(some, (begin, begin + len(x)))
            trust[first:last] = x[some[first:last] - begin]
            predicted[first:last] = rates[some[first:last] - begin]
            bar.update(len(found.log_likelihood))

    sd = np.sqrt(np.maximum(square - mean**2, 0.0))
    latent = Latent(trust, mean, sd, log_likelihood, predicted)
    replicated = _prior_predictive(model, data, observations, seed)
    if "prior" in posterior.children:  # some of its draws may have been selected
        replicated = replicated[posterior["prior"].to_dataset()["draw"].values]
    densities = {name: np.concatenate(parts) for name, parts in log_prior.items()}
    of_counts = of_counts and _all_counted(observations)
    return add_groups(posterior, missions, latent, replicated, densities, of_counts=of_counts)


def log_likelihood_of_function(
    posterior: xr.DataTree, missions: Sequence[Mission], model: FunctionModel
) -> tuple[np.ndarray, bool]:
    """Compute the log-likelihood (draw, mission) of missions at all draws of a posterior.

    The posterior may have been fitted to other rates of the same missions.

    Returns:
        The log-likelihoods, and whether they are of tick counts.
    """
    observations = Observations.from_missions(missions)
    data = _data_for(model, missions, observations)
    sizes = posterior["posterior"].sizes
    n_draws = sizes["chain"] * sizes["draw"]

    of_counts = True
    log_likelihood = np.empty((n_draws, len(missions)))
    for where, found in _evaluated(model, posterior, data, np.arange(n_draws)):
        of_counts = bool(found.of_counts.all())
        log_likelihood[where] = found.log_likelihood[:, : len(missions)]
    return log_likelihood, of_counts and _all_counted(observations)


def forms_of_function(
    posterior: xr.DataTree, missions: Sequence[Mission], model: FunctionModel, some: np.ndarray
) -> Iterator[tuple[StateSpace, Inputs, bool]]:
    """Run a function with some draws of its posterior, given by index.

    Yields:
        For each chunk of draws, the form (draw, group, member), the inputs (draw, mission, bound,
        group, member), and whether the log-likelihoods of these missions are of tick counts.
    """
    observations = Observations.from_missions(missions)
    data = _data_for(model, missions, observations)
    n_missions, n_bounds = observations.contact_rate.shape[:2]
    for _, found in _evaluated(model, posterior, data, some):
        space, inputs = _form_of(found, n_missions, n_bounds)
        yield space, inputs, bool(found.of_counts.all()) and _all_counted(observations)


def _evaluated(
    model: FunctionModel, posterior: xr.DataTree, data: Data, some: np.ndarray
) -> Iterator[tuple[np.ndarray, Found]]:
    """Run a function with some draws of its posterior; yield chunks of indices with their results.

    The random key of a draw does not depend on which other draws are chosen.
    """
    values = _padded_values(posterior, model.sites(data))
    keys = _keys(len(next(iter(values.values()))), posterior.attrs["seed"])
    evaluate = model.over_draws("evaluate", 2, data)
    for begin in range(0, len(some), _SIZE):
        where = some[begin : begin + _SIZE]
        yield where, evaluate({name: v[where] for name, v in values.items()}, keys[where])


def _all_counted(observations: Observations) -> bool:
    """Return whether every measured rate has a number of ticks."""
    is_measured = ~np.isnan(observations.contact_rate)
    is_counted = observations.n_ticks > 0.0
    return bool((is_counted | ~is_measured).all())


def draws_of_function(
    model: FunctionModel, posterior: xr.DataTree, workspace: Workspace | None
) -> FunctionDraws:
    """Return the draws of a posterior of a function, for the bounds of a workspace.

    Raises:
        TrustboError: If the workspace has different robots or features, or the same in a different
            order.
    """
    robots = names_in(posterior, "robot")
    features = names_in(posterior, "feature")
    shape: Any = None
    if workspace is not None:
        require_kind("workspace", workspace, Workspace, "give a trustbo.Workspace")
        robots = workspace.team.names
        features = workspace.features
        shape = workspace.passable.shape
    posterior = in_order_of(posterior, robots, features)

    draws = posterior["posterior"].to_dataset()
    names = json.loads(draws.attrs["common"])
    missing = [name for name in names if safe(name) not in draws]
    if missing:
        raise TrustboError(
            f"the posterior has no variable {missing[0]!r}, only {', '.join(map(str, draws))}. "
            "Give a posterior from trustbo.fit with unchanged names."
        )

    values = {name: joined_draws(draws[safe(name)]) for name in names}
    bad = [name for name, array in values.items() if np.isnan(array).any()]
    if bad:
        raise TrustboError(
            f"draws of {bad[0]!r} are NaN; drop these draws with posterior.isel(draw=...) instead "
            "of masking them."
        )
    return FunctionDraws(model, values, robots, features, shape)


def prior_draws_of_function(
    model: FunctionModel, n_draws: int, seed: int, workspace: Workspace
) -> FunctionDraws:
    """Draw the variables of a function from the prior, for the bounds of a workspace."""
    awareness = workspace.awareness.values
    n_robots, _, rows, cols, _ = awareness.shape
    features = tuple(workspace.features)
    data = _nothing(model, n_robots, features)
    sites = model.sites(data)

    drawn = model.over_draws("prior", 1, data)(_keys(n_draws, seed))
    values = {name: drawn[name] for name, site in sites.items() if site.mission_axis is None}
    if not values:
        raise TrustboError(f"{model.in_short()} has no variable that is common to all missions.")
    return FunctionDraws(model, values, workspace.team.names, features, (rows, cols))


def require_plannable(model: FunctionModel, workspace: Workspace) -> None:
    """Raise TrustboError if a function cannot plan in a workspace."""
    draws = prior_draws_of_function(model, N_CHECKED, 0, workspace)
    draws.require_plannable(workspace.awareness.values)


def require_learnable(model: FunctionModel, workspace: Workspace) -> None:
    """Raise TrustboError if a function cannot be fitted to any mission of a workspace.

    Before there are missions, the checks of `fit_function` are run on an invented mission.
    """
    awareness = workspace.awareness.values
    z = np.moveaxis(awareness, 0, -2)  # (move, row, col, robot, feature)
    known = np.argwhere(~np.isnan(z).any((-2, -1)))[:_INVENTED]
    data = data_of_example(z[tuple(known.T)], known, workspace.features)
    if model.needs_observations:
        data["observations"] = observations_of(data)
    sites = model.sites(data)
    _sampler(model).require_gradient(data, sites)
    if not model.needs_observations:  # its data are not padded
        require_unpadded_results(model, data, sites, [len(known)])


def require_poolable_with_function(
    model: FunctionModel, earlier: Sequence[Mission], robots: Sequence[str]
) -> None:
    """Raise TrustboError if a function cannot be fitted to missions of earlier campaigns.

    A function identifies robots by position, and it would take the cells of another map for those
    of the workspace.
    """
    require_same_robots(model.in_short(), earlier, robots)
    of_places = [name for name in ("cell", "bound") if name in model.inputs]
    if of_places and any(mission.map for mission in earlier):
        raise TrustboError(
            f"{model.in_short()} takes the input {of_places[0]!r}, which has no meaning for "
            "earlier missions on another map; leave them out, or give a function of awareness."
        )


def _data_for(
    model: FunctionModel, missions: Sequence[Mission], observations: Observations
) -> dict[str, Any]:
    """Return the inputs of a function; data that it takes as a single object are not padded."""
    data = data_of(missions, observations, moves="bound" in model.inputs)
    if model.needs_observations:
        n_missions, n_bounds = observations.contact_rate.shape[:2]
        data |= {name: v[:n_missions, :n_bounds] for name, v in arrays_of(data).items()}
        data["observations"] = observations
    return data


def _nothing(model: FunctionModel, n_robots: int, features: tuple[str, ...]) -> dict[str, Any]:
    """Return the inputs of a mission with one bound and no contact rates."""
    z = np.zeros((1, n_robots, len(features)))
    data = data_of_bounds(z, np.full((1, 3), -1), features)
    if model.needs_observations:
        data["observations"] = observations_of(data)
    return data


def _sampler(model: FunctionModel) -> Sampler:
    """Return the sampler of a function, which keeps earlier compilations."""
    if model.sampler is None:
        model.sampler = Sampler(model)
    return model.sampler


class Verdict(NamedTuple):
    """Diagnostics of samples."""

    diagnostics: dict[str, float]
    complaints: list[str]
    """Failed checks."""
    not_identified: list[str]
    """Variables whose chains differ although the chains of the drift and the noises agree."""


def _judge(
    model: FunctionModel, data: Data, samples: Samples, *, patient: bool, last: bool = False
) -> Verdict:
    """Check the chains of the variables or, if `patient`, of the quantities that plans depend on.

    Variables may differ between chains although the drift does not. An example is the weights of a
    neural network, whose units can be exchanged. Therefore, if `patient` is true and the chains of
    the variables are bad, those of the drift and the noises are checked instead. With `patient`, a
    few divergences are also accepted. In the `last` check, the limits for the drift and the noises
    are wider, because plans from a rough posterior are better than plans that ignore a mission.
    """
    diverging = samples.fields["diverging"]
    most = int(_TOLERATED * diverging.size) if patient else 0
    found, complaints = complaints_of(samples.z, diverging, max_divergences=most)
    if not complaints or not patient:
        return Verdict(found, complaints, [])

    used = _used_by_plans(model, data, samples)
    limits: dict[str, Any] = {"max_divergences": most}
    if last:
        limits |= {"max_rhat": _ROUGH_RHAT, "min_ess": _ROUGH_ESS}
    found, complaints = complaints_of(used, diverging, **limits)
    if complaints:
        return Verdict(found, complaints, [])

    # A variable that is itself a noise has the same chains, so the same limits apply to it.
    values = _constrained(model, data, samples)
    shape = diverging.shape
    alone = {
        name: complaints_of({name: v.reshape(*shape, -1)}, diverging, **limits)[1]
        for name, v in values.items()
    }
    return Verdict(found, [], [name for name, failed in alone.items() if failed])


def _constrained(model: FunctionModel, data: Data, samples: Samples) -> dict[str, np.ndarray]:
    """Return the values (draw, ...) of the variables, with chains joined."""
    flat = {name: v.reshape(-1, *v.shape[2:]) for name, v in samples.z.items()}
    return model.over_draws("constrain", 1, data)(flat)


def _used_by_plans(model: FunctionModel, data: Data, samples: Samples) -> dict[str, np.ndarray]:
    """Return the drift in some measured bounds and the form, of shape (chain, draw, number)."""
    shape = samples.fields["diverging"].shape
    n_draws = shape[0] * shape[1]
    values = _constrained(model, data, samples)
    space, inputs = model.over_draws("form", 2, data)(values, _keys(n_draws, 0))

    measured = np.flatnonzero(~np.isnan(data[RATES].ravel()))
    some = measured[np.linspace(0, len(measured) - 1, min(_CHECKED, len(measured))).astype(int)]
    drift = (inputs.drift + inputs.offset).reshape(n_draws, -1)[:, some]

    used = {"drift": drift}
    for name, value in space._asdict().items():
        if value is None:
            continue
        # A variance is checked as the sd that the user gave, because their R-hats differ.
        is_variance = name.endswith("_cov") and value.shape[-1] == 1
        used[name] = np.sqrt(value) if is_variance else value
    return {name: v.reshape(*shape, -1) for name, v in used.items()}


def _sampled(
    model: FunctionModel,
    data: Data,
    sites: Mapping[str, Site],
    start: Start,
    warmup: int,
    draws: int,
    *,
    seed: int,
    progress: bool,
    check: bool,
) -> tuple[Samples, Verdict]:
    """Run NUTS until the diagnostics are good or many draws have been taken.

    Each run starts from draws of the run before, and the draws of all runs are joined. The
    requested number of draws is kept, evenly spaced, or all draws if the checks need more. If a
    transition of the first run or more than 0.5 % of those of a later run diverge, all draws so far
    are discarded, and steps are smaller. From the second run on, a few divergences and variables
    that are not identified are accepted; see `_judge`.

    Returns:
        Samples, and the verdict on them.
    """
    sampler = _sampler(model)
    accept = _ACCEPT
    n_diverged = 0
    runs: list[Samples] = []
    most = min(max(_ATTEMPTS, _MANY // draws), _MOST_ATTEMPTS) if check else 1
    attempt = 0
    while True:
        title = f"NUTS, run {attempt + 1}"
        if most > 1:
            title += f" of at most {most}"
        if n_diverged:
            title += f" ({n_diverged} divergences in the last run)"
        last = sampler.sample(
            data,
            sites,
            start,
            warmup,
            draws,
            accept=accept,
            seed=int(np.random.SeedSequence([seed, attempt]).generate_state(1)[0]),
            progress=progress,
            title=title,
        )
        attempt += 1
        patient = attempt >= _PATIENT
        n_diverged = int(last.fields["diverging"].sum())
        share = last.fields["diverging"].mean()
        is_bad = share > (_TOLERATED if patient else 0.0)
        if is_bad:
            runs = []
            accept = _LAST_ACCEPT

        joined = joined_samples([*runs, last])
        is_last = attempt == most
        verdict = _judge(model, data, joined, patient=patient, last=is_last)
        if not verdict.complaints or is_last:
            if not runs:  # one run has the requested number of draws
                return joined, verdict
            few = joined.some(draws)
            of_few = _judge(model, data, few, patient=patient)
            return (joined, verdict) if of_few.complaints else (few, of_few)

        if not is_bad:
            runs.append(last)
        x = coordinates_of(last.z)
        start = warm_start(x, last.step_size, len(start.x), seed + attempt)


def _start(
    model: FunctionModel,
    sites: Mapping[str, Site],
    data: Data,
    previous: xr.DataTree | None,
    chains: int,
    seed: int,
) -> Start:
    """Return the starts of the chains, which are draws of a previous posterior of the function.

    If the previous posterior has other variables, or a variable has an axis of missions, the starts
    are random.
    """
    with own_settings():
        free = free_shapes(model, sites, data)
    n = sum(values.size for values in free.values())
    if previous is None or previous.attrs["model_record"] != model.text:
        return cold_start(n, chains, seed)

    draws = previous["posterior"].to_dataset()
    values = {name: joined_draws(draws[safe(name)]) for name in sites if safe(name) in draws}
    for name, site in sites.items():
        is_same = name in values and values[name].shape[1:] == site.shape
        if site.mission_axis is not None or not is_same:
            return cold_start(n, chains, seed)

    z = model.over_draws("unconstrain", 1, data)(values)
    x = coordinates_of({name: array[None] for name, array in z.items()})
    if not np.isfinite(x).all():
        return cold_start(n, chains, seed)
    return warm_start(x, previous.attrs["step_size"], chains, seed)


def _keys(n: int, seed: int) -> Any:
    """Return n random keys."""
    with own_settings():
        return jax.random.split(jax.random.key(seed), n)


def _without_padding(values: np.ndarray, site: Site, n_missions: int) -> np.ndarray:
    """Drop the missions of the padding from values (chain, draw, ...)."""
    if site.mission_axis is None:
        return values
    return values.take(range(n_missions), axis=2 + site.mission_axis)


def _padded_values(posterior: xr.DataTree, sites: Mapping[str, Site]) -> dict[str, np.ndarray]:
    """Return draws (draw, ...) of the variables; values are arbitrary for padded missions."""
    draws = posterior["posterior"].to_dataset()
    values = {}
    for name, site in sites.items():
        array = joined_draws(draws[safe(name)])
        if site.mission_axis is not None:
            axis = 1 + site.mission_axis
            n_missing = site.shape[site.mission_axis] - array.shape[axis]
            last = array.take([-1] * n_missing, axis=axis)
            array = np.concatenate([array, last], axis=axis)
        values[name] = array
    return values


def _form_of(found: Found, n_missions: int, n_bounds: int) -> tuple[StateSpace, Inputs]:
    """Return the form (draw, group, member) and the inputs without padding."""
    fields = [None if value is None else value[:, 0] for value in found.space]
    inputs = [value[:, :n_missions, :n_bounds] for value in found.inputs]
    return StateSpace(*fields), Inputs(*inputs)


def _by_mission(inputs: Inputs) -> Iterator[list[Inputs]]:
    """Yield the inputs (draw, group, member) of each bound, for each mission."""
    drift = inputs.drift
    offset = np.broadcast_to(inputs.offset, drift.shape)
    for j in range(drift.shape[1]):
        yield [Inputs(drift[:, j, k], offset[:, j, k]) for k in range(drift.shape[2])]


def _drawn_trust(
    space: StateSpace, inputs: Inputs, observations: Observations, rng: np.random.Generator
) -> np.ndarray:
    """Draw trust (draw, mission, bound, robot) given the rates of all missions."""
    n_draws, _, n_bounds, n_groups, n = inputs.drift.shape
    trust = np.empty((n_draws, *observations.contact_rate.shape))
    for j, of_bounds in enumerate(_by_mission(inputs)):
        rates = observations.contact_rate[j].reshape(n_bounds, n_groups, n)
        drawn = kalman.draw_trust(space, of_bounds, rates, n_groups, rng)
        trust[:, j] = drawn.reshape(n_draws, n_bounds, -1)
    return trust


def _replicated(
    space: StateSpace, inputs: Inputs, observations: Observations, rng: np.random.Generator
) -> np.ndarray:
    """Draw replicated rates (draw, mission, bound, robot)."""
    n_draws, _, n_bounds, n_groups, n = inputs.drift.shape
    family = FAMILIES["gaussian"]
    rates = np.empty((n_draws, *observations.contact_rate.shape))
    for j, of_bounds in enumerate(_by_mission(inputs)):
        ticks = observations.n_ticks[j].reshape(n_bounds, n_groups, n)
        begin = kalman.initial(space, n_groups)
        drawn = kalman.forecast(space, begin, of_bounds, ticks, family, rng)
        rates[:, j] = np.stack([of_robots for _, of_robots in drawn], axis=1)
    return rates


def _prior_predictive(
    model: FunctionModel, data: Data, observations: Observations, seed: int
) -> np.ndarray:
    """Draw rates (draw, mission, bound, robot) of the missions from the prior."""
    keys = _keys(N_PRIOR, seed + _OF_PRIOR)
    values = model.over_draws("prior", 1, data)(keys)
    found: Found = model.over_draws("evaluate", 2, data)(values, keys)
    n_missions, n_bounds = observations.contact_rate.shape[:2]
    space, inputs = _form_of(found, n_missions, n_bounds)
    rng = stream(seed, "prior predictive")
    return _replicated(space, inputs, observations, rng)


def _tree(
    model: FunctionModel,
    values: Mapping[str, np.ndarray],
    sites: Mapping[str, Site],
    stats: Mapping[str, np.ndarray],
    missions: Sequence[Mission],
    data: Data,
    seed: int,
) -> xr.DataTree:
    """Build a DataTree from draws (draw, ...) of the variables, statistics (chain, draw) and data.

    The groups `posterior` and `prior` include sites of `numpyro.deterministic`.
    """
    computed = model.computed_sites(data)
    stored = {**sites, **computed}
    prior = model.over_draws("prior", 1, data)(_keys(N_PRIOR, seed + _OF_PRIOR))

    def by_chain(values: Mapping[str, np.ndarray], shape: tuple[int, ...]) -> dict[str, Any]:
        whole = {**values, **_computed(model, values, computed, data)}
        arrays = {name: whole[name].reshape(*shape, *whole[name].shape[1:]) for name in stored}
        return {
            safe(name): _without_padding(array, stored[name], len(missions))
            for name, array in arrays.items()
        }

    groups = {
        "posterior": by_chain(values, stats["lp"].shape),
        "sample_stats": dict(stats),
        "prior": by_chain(prior, (1, N_PRIOR)),
    }
    shapes = {name: groups["posterior"][safe(name)].shape[2:] for name in stored}
    dims = _dims_of(stored, shapes, _sizes_of_axes(missions))
    labels = {
        own: _labels_of(dim, n, missions)
        for name, site in stored.items()
        for own, dim, n in zip(dims[safe(name)], site.dims, shapes[name], strict=True)
    }
    tree = to_datatree(groups, missions, dims, labels=labels)
    common = [name for name, site in sites.items() if site.mission_axis is None]
    tree["posterior"].attrs["common"] = json.dumps(common)
    tree["posterior"].attrs["dims"] = json.dumps(dims)
    return tree


def _computed(
    model: FunctionModel, values: Mapping[str, np.ndarray], sites: Mapping[str, Site], data: Data
) -> dict[str, np.ndarray]:
    """Compute the sites of `numpyro.deterministic` at values (draw, ...) of the variables."""
    if not sites:
        return {}

    n_draws = len(next(iter(values.values())))
    keys = _keys(n_draws, 0)
    compute = model.over_draws("deterministic", 2, data)
    parts = []
    for begin in range(0, n_draws, _SIZE):  # sites that are left out may be large
        some = slice(begin, begin + _SIZE)
        found = compute({name: v[some] for name, v in values.items()}, keys[some])
        parts.append({name: found[name] for name in sites})
    return {name: np.concatenate([part[name] for part in parts]) for name in sites}


def _dims_of(
    sites: Mapping[str, Site], shapes: Mapping[str, tuple[int, ...]], sizes: Mapping[str, int]
) -> dict[str, tuple[str, ...]]:
    """Return the names of the axes of variables, by name.

    The suffix `_plate` is added to the name of an axis if it is the name of a variable, or that of
    an axis of posteriors with a different size. The second axis of a variable with the same name
    has the suffix `_`, as in model classes.
    """
    taken = {"chain", "draw", "bound", *map(safe, sites)}
    known: dict[str, int] = {}

    def label(name: str, dim: str, n: int) -> str:
        own = safe(dim)
        if own in taken or sizes.get(own, n) != n:
            own = f"{own}_plate"
        if known.setdefault(own, n) != n:  # two plates with one name
            own = f"{safe(name)}_{own}"
        return own

    named: dict[str, tuple[str, ...]] = {}
    for name, site in sites.items():
        own: list[str] = []
        for dim, n in zip(site.dims, shapes[name], strict=True):
            one = label(name, dim, n)
            while one in own:
                one += "_"
            own.append(one)
        named[safe(name)] = tuple(own)
    return _in_one_order(named)


def _in_one_order(dims: Mapping[str, tuple[str, ...]]) -> dict[str, tuple[str, ...]]:
    """Return axes with the name of the variable added if their order differs between variables.

    `az.summary` would label the values of such a variable incorrectly; see `tree`.
    """
    order: list[str] = []
    renamed = dict(dims)
    for name in sorted(dims, key=lambda name: -len(dims[name])):  # that of `to_datatree`
        seen = [dim for dim in order if dim in dims[name]]
        n_seen = len(seen)
        if dims[name][:n_seen] != tuple(seen):
            renamed[name] = tuple(f"{name}_{dim}" for dim in dims[name])
        order += [dim for dim in renamed[name] if dim not in order]
    return renamed


def _labels_of(dim: str, n: int, missions: Sequence[Mission]) -> Any:
    """Return the labels of an axis: names of robots or features, if it has their name and size."""
    kind = dim.rsplit("/")[-1]  # without the prefixes of `numpyro.handlers.scope`
    names = {"robot": missions[0].robots, "feature": missions[0].features}
    for one, of_axis in names.items():
        if kind in (one, f"{one}s") and n == len(of_axis):
            return list(of_axis)
    return np.arange(n)


def _sizes_of_axes(missions: Sequence[Mission]) -> dict[str, int]:
    """Return the lengths of the axes that posteriors of all models have."""
    n_robots = len(missions[0].robots)
    return {
        "mission": len(missions),
        "bound": max(len(mission.bounds) for mission in missions),
        "robot": n_robots,
        "robot_": n_robots,
        "feature": len(missions[0].features),
        "feature_": len(missions[0].features),
    }
