"""The choice of a sampler for a NumPyro function, and the checks of its draws."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
import xarray as xr

from trustbo.arrays import evenly_spaced, joined_draws
from trustbo.display import joined as joined_names
from trustbo.display import slow_bar
from trustbo.errors import TrustboError, warn
from trustbo.inference.agreed import Chart, sample_charts
from trustbo.inference.diagnostics import MAX_RHAT, MIN_ESS, complaints_of, statistics_of
from trustbo.inference.functions.data import RATES
from trustbo.inference.functions.explain import reason_of
from trustbo.inference.functions.function import FunctionModel, keys_of
from trustbo.inference.functions.sites import safe
from trustbo.inference.functions.target import Scaled, Target
from trustbo.inference.importance import Points
from trustbo.inference.nuts import Chains, Samples, Start, Tuning
from trustbo.inference.options import Options
from trustbo.models.backend import own_settings
from trustbo.streams import stream

AUTO, IMPORTANCE, NUTS = SAMPLERS = ("auto", "importance", "nuts")
"""Names of the samplers of functions."""
_WARMUP = 300
"""Warm-up draws per chain of NUTS, which are discarded."""
_ACCEPT = 0.95
"""Target of the acceptance probability."""
_LAST_ACCEPT = 0.99
"""Target of the acceptance probability after many divergent transitions."""
_TOLERATED = 0.005
"""Fraction of divergent transitions that is accepted, with a warning."""
_MOST_DRAWS = 4000
"""Number of draws per chain after which NUTS is not continued."""
_ROUGH_RHAT = 1.1
"""Largest R-hat of the drift and the noises that the last check accepts, with a warning."""
_ROUGH_ESS = 50.0
"""Smallest bulk ESS of the drift and the noises that the last check accepts."""
_NAMES_OF_FIELDS = {
    "transition": "beta0",
    "process_cov": "delta_w",
    "initial_mean": "x0_mean",
    "initial_cov": "x0_sd",
    "noise_sd": "delta_v",
    "shared_cov": "delta_s",
}
"""Names of the fields of a form as arguments of `ContactRate`."""
_CHECKED = 100
"""Largest number of measured bounds whose drift is checked."""
_N_STARTS = 1000
"""Largest number of draws of a previous posterior to which the first proposal is fitted."""


class Drawn(NamedTuple):
    """Draws from the posterior of a function."""

    values: dict[str, np.ndarray]
    """Values (draw, ...) of the variables, with chains joined."""
    statistics: dict[str, np.ndarray]
    """Statistics (chain, draw) of the sampler, by ArviZ's names."""
    attrs: dict[str, Any]
    """Name of the sampler, and its diagnostics."""
    complaints: list[str]
    """Failed checks."""
    effects: dict[str, dict[str, np.ndarray]] | None = None
    """Variables (draw, ...) of the effects of the function, by group and name."""


def sampled(
    targets: Sequence[Target], prior: Mapping[str, np.ndarray], draws: int, options: Options
) -> Drawn:
    """Sample a posterior by importance sampling, or by NUTS where this fails.

    Args:
        targets: The posterior in all coordinates; see `targets_of`.
        prior: Values (draw, ...) of the variables, drawn from the prior.
        draws: Number of draws per chain; importance sampling draws as many in one chain.
        options: Other options.
    """
    target = targets[0]
    sampler = options.sampler
    seed = options.seed
    known = _values_of(options.start, target, seed)
    if known is not None and not _is_possible(target, known):
        known = None
    found = None
    if sampler != NUTS or known is None:  # also for the starts of NUTS
        starts = [prior] if known is None else [known, prior]
        with slow_bar("fit", " points", options.progress) as bar:
            scaled = [Scaled(one, prior, bar) for one in targets]
            charts = [_chart(one, scaled[0], starts) for one in scaled]
            found = sample_charts(charts, seed, target.coordinates.names)
            found = found._replace(x=scaled[0].unscaled(found.x))
        is_slow = target.integrated is not None  # NUTS would take many minutes
        is_enough = sampler == AUTO and (is_slow or not found.complaints)
        if sampler == IMPORTANCE or is_enough:
            return _resampled(target, found, options.chains * draws, seed)

    if target.integrated is None:
        require_gradient(target)
    if found is None:
        x = target.finite_points(known or prior)
    else:
        x = found.x[found.resample(_N_STARTS, stream(seed, "starts of chains"))]
    start = Start.near(x, options.chains, seed)
    warmup = _WARMUP if options.warmup is None else options.warmup
    drawn = _by_nuts(
        target, start, warmup, draws, seed=seed, progress=options.progress, check=options.check
    )
    if drawn.complaints and options.check and found is None:  # the start may be far away
        return sampled(targets, prior, draws, options._replace(start=None))
    return drawn


def _chart(own: Scaled, first: Scaled, starts: Sequence[Mapping[str, np.ndarray]]) -> Chart:
    """Return the coordinates of a target."""
    points = [own.points(values) for values in starts]
    finite = [x[np.isfinite(x).all(1)] for x in points]
    return Chart(
        own.log_density,
        [x for x in finite if len(x)],
        to_first=lambda x: x if own is first else first.points(own.values(x)),
        from_first=lambda x: x.copy() if own is first else own.points(first.values(x)),
    )


def _values_of(
    previous: xr.DataTree | None, target: Target, seed: int
) -> dict[str, np.ndarray] | None:
    """Return values (draw, ...) of draws of a previous posterior of the same function.

    Variables of missions that it does not have are drawn from the prior given the others. The
    result is None if there is no such posterior, or if it has other variables.
    """
    model = target.model
    if previous is None or previous.attrs["model_record"] != model.text:
        return None

    draws = previous["posterior"].to_dataset()
    stored = {name: joined_draws(draws[safe(name)]) for name in target.sites if safe(name) in draws}
    n_draws = len(next(iter(stored.values()), []))
    chosen = evenly_spaced(n_draws, _N_STARTS)
    values = {name: array[chosen] for name, array in stored.items()}

    common = {}
    for name, site in target.sites.items():
        if site.mission_axis is None:
            if name not in values or values[name].shape[1:] != site.shape:
                return None
            common[name] = values[name]
    if len(common) == len(target.sites):
        return common
    if not common:
        return None

    keys = keys_of(len(chosen), seed)
    drawn = dict(model.over_draws("prior_given", 2, target.data)(common, keys))
    for name, site in target.sites.items():
        if site.mission_axis is not None and name in values:
            shape = values[name].shape[1:]
            if len(shape) == len(site.shape) and np.all(np.less_equal(shape, site.shape)):
                drawn[name] = drawn[name].copy()
                drawn[name][(slice(None), *map(slice, shape))] = values[name]
    return drawn


def _is_possible(target: Target, values: Mapping[str, np.ndarray]) -> bool:
    """Return whether any draw of the variables has a positive density."""
    x = target.finite_points(values)
    return len(x) > 0 and bool(np.isfinite(target.log_density(x)).any())


def _resampled(target: Target, found: Points, n: int, seed: int) -> Drawn:
    """Return n equally weighted draws of weighted points."""
    chosen = found.resample(n, stream(seed, "draws of points"))
    x = found.x[chosen]
    attrs = {
        "sampler": IMPORTANCE,
        "k_hat": found.k_hat,
        "kish": found.kish,
        "log_evidence": found.log_evidence,
    }
    lp = found.log_p[chosen][None]
    effects = target.draw_effects(x, stream(seed, "draws of effects"))
    return Drawn(target.values(x), {"lp": lp}, attrs, list(found.complaints), effects)


class Verdict(NamedTuple):
    """Diagnostics of samples of NUTS."""

    diagnostics: dict[str, float]
    complaints: list[str]
    """Failed checks."""
    not_identified: list[str]
    """Variables whose chains differ although the chains of the drift and the noises agree."""


def _by_nuts(
    target: Target,
    start: Start,
    warmup: int,
    draws: int,
    *,
    seed: int,
    progress: bool,
    check: bool,
) -> Drawn:
    """Run NUTS until the diagnostics are good or many draws have been taken.

    The requested number of draws is kept, evenly spaced, or all draws if the checks need more. If
    many transitions diverge, the chains start again from their draws, once, with smaller steps.
    """
    tuning = Tuning(warmup, _ACCEPT)
    options: dict[str, Any] = {"seed": seed, "progress": progress}
    options["who"] = target.model.in_short()
    chains = Chains(target.traced, target.compiled_for_nuts, tuning, **options)
    samples = chains.run(start, draws)
    if check and samples.fields["diverging"].mean() > _TOLERATED:
        start = Start.near(samples.points, len(start.x), seed + 1)
        tuning = Tuning(warmup, _LAST_ACCEPT)
        chains = Chains(target.traced, target.compiled_for_nuts, tuning, **options)
        samples = chains.run(start, draws)

    patient = False
    verdict = _judge(target, samples, patient=False)
    while verdict.complaints and check:
        patient = True
        is_last = samples.x.shape[1] >= _MOST_DRAWS
        verdict = _judge(target, samples, patient=True, last=is_last)
        if not verdict.complaints or is_last:
            break
        samples = Samples.joined([samples, chains.proceed(samples.x.shape[1])])

    few = samples.some(draws)
    of_few = verdict if few.x.shape == samples.x.shape else _judge(target, few, patient=patient)
    if not of_few.complaints:
        samples, verdict = few, of_few

    attrs = {"sampler": NUTS, **verdict.diagnostics, "not_identified": verdict.not_identified}
    statistics = statistics_of(samples.fields)
    if not verdict.complaints:
        _warn(target.model, verdict, statistics["diverging"].size)
    effects = target.draw_effects(samples.points, stream(seed, "draws of effects"))
    return Drawn(target.values(samples.points), statistics, attrs, verdict.complaints, effects)


def _judge(target: Target, samples: Samples, *, patient: bool, last: bool = False) -> Verdict:
    """Check the chains of the variables or, if `patient`, of the quantities that plans depend on.

    Variables may differ between chains although the drift does not. An example is the weights of a
    neural network, whose units can be exchanged. Therefore, if `patient` is true and the chains of
    the variables are bad, those of the drift and the noises are checked instead. With `patient`, a
    few divergences are also accepted. In the `last` check, the limits for the drift and the noises
    are wider, because plans from a rough posterior are better than plans that ignore a mission.
    """
    diverging = samples.fields["diverging"]
    most = int(_TOLERATED * diverging.size) if patient else 0
    shape = diverging.shape
    of_variables = {
        name: samples.x[..., [name == own for own in target.coordinates.names]]
        for name in target.sites
    }
    found, complaints = complaints_of(of_variables, diverging, max_divergences=most)
    if not complaints or not patient:
        return Verdict(found, complaints, [])

    values = target.values(samples.points)
    used = _used_by_plans(target, values, shape)
    limits: dict[str, Any] = {"max_divergences": most}
    if last:
        limits |= {"max_rhat": _ROUGH_RHAT, "min_ess": _ROUGH_ESS}
    found, complaints = complaints_of(used, diverging, **limits)
    if complaints:
        return Verdict(found, complaints, [])

    # A variable that is itself a noise has the same chains, so the same limits apply to it.
    alone = {
        name: complaints_of({name: v.reshape(*shape, -1)}, diverging, **limits)[1]
        for name, v in values.items()
    }
    return Verdict(found, [], [name for name, failed in alone.items() if failed])


def _used_by_plans(
    target: Target, values: Mapping[str, np.ndarray], shape: Sequence[int]
) -> dict[str, np.ndarray]:
    """Return the drift in some measured bounds and the form, of shape (chain, draw, number)."""
    n_draws = shape[0] * shape[1]
    run = target.model.over_draws("space_and_inputs", 2, target.data)
    space, inputs = run(values, keys_of(n_draws, 0))

    measured = np.flatnonzero(~np.isnan(target.data[RATES].ravel()))
    some = measured[evenly_spaced(len(measured), _CHECKED)]
    drift = (inputs.drift + inputs.offset).reshape(n_draws, -1)[:, some]

    used = {"drift": drift}
    for field, value in space._asdict().items():
        if value is None:
            continue
        # A variance is checked as the sd that the user gave, because their R-hats differ.
        is_variance = field.endswith("_cov") and value.shape[-1] == 1
        used[_NAMES_OF_FIELDS[field]] = np.sqrt(value) if is_variance else value
    return {name: v.reshape(*shape, -1) for name, v in used.items()}


def _warn(model: FunctionModel, verdict: Verdict, n_transitions: int) -> None:
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


def require_gradient(target: Target) -> None:
    """Raise TrustboError if JAX cannot differentiate the density of a function.

    The gradient is traced without computing anything.
    """

    def slope(x: Any) -> Any:
        return jax.grad(lambda x: target.traced(x, target.data))(x)

    try:
        with own_settings():
            jax.eval_shape(slope, np.zeros(target.coordinates.n))
    except TrustboError:
        raise
    except Exception as error:
        reason = reason_of(error).rstrip(".")
        raise TrustboError(
            f"{target.model.in_short()} has no gradient, which NUTS needs: {reason}. Use "
            "jax.lax.scan for loops, or jax.lax.fori_loop with constant bounds, and define the "
            "gradient of callbacks with jax.custom_jvp or jax.custom_vjp."
        ) from error
