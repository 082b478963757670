"""Reports of people under a posterior of `HumanTrust`: latent trust, likelihoods, predictions."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import xarray as xr
from scipy import special

from trustbo.answers import answer_of
from trustbo.data import Mission
from trustbo.errors import TrustboError, require_choice, require_whole
from trustbo.inference.draws import effects_of, is_of_people, sites_of, theta_of, values_of
from trustbo.inference.evidence.blocks import Blocks
from trustbo.inference.posterior_tree import require_posterior
from trustbo.inference.samplers.people import evidence_of
from trustbo.models.effects.effect import Slots, Theta
from trustbo.models.families.terms import GAUSSIAN, NONE
from trustbo.models.people import HumanTrust
from trustbo.models.priors import Priors
from trustbo.models.scales import Scale, normal_between
from trustbo.stacking import MissionBatch, stack_missions

QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
GIVEN = ("earlier", "none")
_PARTICLES = 8  # of a likelihood
_ALIKE = 16  # draws of a person's trust for each draw of what persons share
_LIKELIHOOD = "log_likelihood"


def model_of_people(posterior: xr.DataTree) -> HumanTrust:
    """Model of a posterior, as far as its draws leave anything open: not its priors."""
    attrs = posterior.attrs
    x0 = {name: float(attrs[name]) for name in ("x0_mean", "x0_sd")}
    names = ("asymmetric", "persons", "scale", "inputs")
    options = {name: attrs[name] for name in names}
    memory = attrs.get("memory", "level")
    effects = effects_of(posterior)
    return HumanTrust(priors=replace(Priors(), **x0), effects=effects, memory=memory, **options)


def groups_of_people(
    posterior: xr.DataTree, missions: Sequence[Mission], kept: np.ndarray
) -> dict[str, dict[str, Any]]:
    """Groups that `complete` adds: arrays by name, leading axes (chain, draw) but of moments.

    Likelihoods of a mission have the person's effects integrated out: leaving a mission out leaves
    out a person. Predictions are of the same persons anew.

    Args:
        posterior: Posterior.
        missions: Its missions.
        kept: Indices of the draws of a chain whose trust is kept.
    """
    model, batch = model_of_people(posterior), stack_missions(missions, pad=False)
    seed, n_chains = posterior.attrs["seed"], posterior["posterior"].sizes["chain"]
    rng, sites = np.random.default_rng([seed, 1]), sites_of(posterior)
    theta, c = draws_of(model, sites)
    slots = every_slot(model, batch)  # every bound has trust, with a report or without
    evidence = evidence_of(model, slots, np.ones(slots.y.shape, dtype=bool))
    evidence.recentre({name: values.mean(0, keepdims=True) for name, values in theta.items()})
    points = np.column_stack([*theta.values(), c])
    _, first, index = np.unique(points, axis=0, return_index=True, return_inverse=True)
    index = index.ravel()  # resampled draws repeat: each is evaluated once
    some = {name: values[first] for name, values in theta.items()}
    x, log_likelihood, _ = evidence.given(some, c[first], rng, _PARTICLES)
    chain, k = evidence.at
    n_missions, n_bounds, n_robots = batch.contact_rate.shape
    trust = np.full((len(x), n_missions, n_bounds, n_robots), np.nan)
    trust[:, slots.mission[chain], k, slots.robot[chain]] = x
    mean = np.bincount(index) @ trust.reshape(len(x), -1) / len(index)
    square = np.bincount(index) @ trust.reshape(len(x), -1) ** 2 / len(index)
    sd = np.sqrt(np.maximum(square - mean**2, 0.0))
    effect = model.effect
    (own,) = values_of(posterior, effect).values()
    predicted = simulate_people(model, slots, theta, c, own, rng)[1]
    before = {str(n): a.values[0] for n, a in posterior["prior"].data_vars.items()}
    rng = np.random.default_rng(seed + 3)
    anew = draw_people(model, slots, before, rng)["contact_rate"]

    def by_chain(array: np.ndarray) -> np.ndarray:
        return array.reshape(n_chains, -1, *array.shape[1:])

    return {
        _LIKELIHOOD: {"contact_rate": by_chain(log_likelihood[index])},
        "latent": {
            "trust": by_chain(trust[index])[:, kept],
            "trust_mean": mean.reshape(trust.shape[1:]),
            "trust_sd": sd.reshape(trust.shape[1:]),
            "draw": kept,
        },
        "posterior_predictive": {"contact_rate": by_chain(predicted)},
        "prior_predictive": {"contact_rate": anew[None]},
    }


def every_slot(model: HumanTrust, batch: MissionBatch) -> Slots:
    """All bounds of all chains, with the reports that there are."""
    slots = Slots.every(batch, len(batch.awareness), model.names, None)
    y = np.swapaxes(batch.contact_rate, 1, 2)[slots.mission, slots.robot]
    model.levels.require(y, slots.n_ticks)  # pyright: ignore[reportArgumentType]
    return slots._replace(y=y)


def draw_people(
    model: HumanTrust, slots: Slots, sites: Mapping[str, np.ndarray], rng: np.random.Generator
) -> dict[str, np.ndarray]:
    """Persons' own parts (draw, mission, part) and reports, under draws of the prior by name."""
    theta, c = draws_of(model, sites)
    sds = model.effect.group(slots).sds(theta)
    own = sds[:, None] * rng.standard_normal((len(c), slots.n_missions, sds.shape[1]))
    own[:, :, 1] /= theta["rest"][:, None]
    reports = simulate_people(model, slots, theta, c, own, rng)[1]
    return {"person": own, "contact_rate": reports}


def simulate_people(
    model: HumanTrust,
    slots: Slots,
    theta: Theta,
    c: np.ndarray,
    own: np.ndarray,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    """Trust and reports drawn anew, each (draw, mission, bound, robot), NaN where no chain is.

    Args:
        model: Model.
        slots: All bounds of all chains.
        theta: Hyperparameters, each (draw,).
        c: Shared coefficients (draw, column).
        own: Parts of persons (draw, mission, part), levels in units of stationary trust.
        rng: Random number generator.
    """
    columns = model.effect.group(slots)
    U = model.shared(slots).columns.toarray().reshape(*slots.y.shape, -1)
    of_person = columns.coefficients({"person": own}, theta).reshape(own.shape)[:, slots.mission]
    masks = [mask.astype(float) for mask in model.lasting]
    base, impulse = (
        np.einsum("chd,nd->nch", U * some[0], c)
        + np.einsum("chl,ncl->nch", columns.values * some[1], of_person)
        for some in ([1.0 - mask for mask in masks], masks)
    )
    d = np.full(base[:, :, 0].shape, float(model.priors.x0_mean))
    d += float(model.priors.x0_sd) * rng.standard_normal(d.shape)
    trust, n_bounds = np.empty(base.shape), U.shape[1]
    for k in range(n_bounds):
        w = theta["delta_w"][:, None] * rng.standard_normal(d.shape)
        d = theta["beta0"][:, None] * d + impulse[:, :, k] + w
        trust[:, :, k] = base[:, :, k] + d
    noise = model.levels.draw_noise(trust.shape, rng) * theta["delta_v"][:, None, None]
    reports = model.levels.record(trust + noise, theta)
    shape = len(c), slots.n_missions, n_bounds, slots.n_robots
    out = np.full((2, *shape), np.nan)
    for values, into in zip((trust, reports), out, strict=True):
        into[:, slots.mission, :, slots.robot] = np.swapaxes(values, 0, 1)
    return out[0], out[1]


def predict_reports(
    posterior: xr.DataTree,
    missions: Sequence[Mission],
    *,
    given: str = "earlier",
    fitted: bool = False,
    n_draws: int = 2000,
    seed: int = 0,
) -> xr.Dataset:
    """Predict each report of persons, who may be new, from their reports at earlier bounds.

    Reports weigh the draws of the posterior, by which a person's start, level and gains are
    learned; reports of one bound do not predict each other.

    Args:
        posterior: Posterior of `HumanTrust`.
        missions: Persons; where a report is NaN it is predicted too.
        given: `"earlier"`, or `"none"`: no report of the person is known.
        fitted: Whether the fit had the earlier reports of these persons: they then weigh no draws
            of what all persons share a second time.
        n_draws: Number of draws of a person's trust at most.
        seed: Seed of the draws.

    Returns:
        Dataset over (mission, bound, robot): `report`, its `mean` and `quantile` (also over
        `level`), on the scale that was answered, such as 1 to 7; `log_score`, nats, of the report's
        mass (on the unit scale its density, but at 0 and 1 its mass), and with levels the
        `probability` of each `answer`. Attributes: the mean absolute error `mae` of medians, the
        `mean_log_score`, and `coverage_90` of central intervals.

    Raises:
        TrustboError: No posterior of `HumanTrust`; missions of other inputs, or of another scale.
    """
    if not is_of_people(require_posterior("predict_reports", posterior)):
        raise TrustboError(
            f"predict_reports takes a posterior of HumanTrust; got one of "
            f"{posterior.attrs.get('model')}. Use trustbo.inference.score."
        )
    require_choice("given", given, GIVEN)
    require_whole("seed", seed, 0)
    model, scale = (m := model_of_people(posterior)), m.levels
    batch = stack_missions(missions, pad=False)
    if missions[0].features != model.names:
        raise TrustboError(
            f"the posterior has inputs {model.names}, the missions {missions[0].features}; give "
            "missions of the same."
        )
    slots = every_slot(model, batch)
    evidence = evidence_of(model, slots, np.ones(slots.y.shape, dtype=bool))
    theta, c = draws_of(model, sites_of(posterior))
    n = require_whole("n_draws", n_draws, 1)
    n = max(1, n // _ALIKE) if fitted else n
    some = np.unique(np.linspace(0, len(c) - 1, n).astype(int))
    some = np.repeat(some, _ALIKE) if fitted else some
    theta, c = {name: values[some] for name, values in theta.items()}, c[some]
    shape = batch.contact_rate.shape
    out: dict[str, np.ndarray] = {name: np.full(shape, np.nan) for name in ("mean", "log_score")}
    out["quantile"] = np.full((*shape, len(QUANTILES)), np.nan)
    if scale.levels:
        out["probability"] = np.full((*shape, scale.levels), np.nan)
    for j in range(shape[0]):
        alike = _ALIKE if fitted else len(c)
        for where, values in _of_person(evidence, theta, c, j, scale, given, alike, [seed, j]):
            for name, value in values.items():
                out[name][(j, *where)] = value
    ended = np.arange(shape[1]) >= np.array([len(m.bounds) for m in missions])[:, None]
    for values in out.values():
        values[ended] = np.nan
    for name in ("mean", "quantile"):
        out[name] = answer_of(out[name], scale.levels)
    return _dataset(answer_of(batch.contact_rate, scale.levels), out, scale, missions[0].robots)


def _of_person(
    evidence: Blocks,
    theta: Theta,
    c: np.ndarray,
    j: int,
    scale: Scale,
    given: str,
    alike: int,
    seed: list[int],
):
    """Yield (bound, robot) and predictions of each row of a mission.

    Runs of `alike` draws have one weight in all.
    """
    rng = np.random.default_rng(seed)
    (i,) = np.flatnonzero(evidence.index == j)
    rows = np.arange(evidence.rows.start[i], evidence.rows.start[i + 1])
    chain, bound = evidence.at[:, rows]
    mean, cov = evidence.moments(theta, c, j)
    order = np.argsort(bound, kind="stable")
    cov = cov[:, order[:, None], order] + 1e-12 * np.eye(len(order))
    mean, rows, chain, bound = mean[:, order], rows[order], chain[order], bound[order]
    factor = np.linalg.cholesky(cov)
    kind, case, y = (getattr(evidence.rows, name)[rows] for name in ("kind", "case", "y"))
    limits, delta_v = scale.limits(theta), theta["delta_v"]
    e, log_w = np.zeros(mean.shape), np.zeros(len(c))
    log_w_next = log_w.copy()
    start = 0
    for r in range(len(rows)):
        if bound[r] != bound[start] or r == 0:
            start, log_w = r, log_w_next.copy()
        runs = log_w.reshape(-1, alike)
        w = np.exp(runs - np.logaddexp.reduce(runs, axis=1, keepdims=True)).ravel() / len(runs)
        past = e[:, :start] if given == "earlier" else e[:, :0]
        center = mean[:, r] + (factor[:, r, : past.shape[1]] * past).sum(1)
        trust_var = (factor[:, r, past.shape[1] : r + 1] ** 2).sum(1)
        spread = np.sqrt(trust_var[:, None] + (delta_v[:, None] * scale.noise[:, 1]) ** 2)
        yield (
            (bound[r], evidence.slots.robot[chain[r]]),
            _prediction(scale, w, center, spread, limits, kind[r], case[r], y[r], rng),
        )
        if given == "none":
            continue
        # Trust given the report, and those before: rows of one bound tell of each other here.
        a = mean[:, r] + (factor[:, r, :r] * e[:, :r]).sum(1)
        d = factor[:, r, r]
        if kind[r] == NONE:
            e[:, r] = rng.standard_normal(len(e))
            continue
        noise = delta_v[:, None] * scale.noise[:, 1]
        if kind[r] == GAUSSIAN:
            noise = noise[:, 0]
            total = np.hypot(d, noise)
            z = y[r] - a
            log_w_next += -0.5 * (z / total) ** 2 - np.log(total)
        else:
            low, high = limits[:, case[r]].T
            total = np.hypot(d[:, None], noise)
            off = [(end - a)[:, None] / total for end in (low, high)]
            log_p = normal_between(*off, 0.5)[0] + np.log(scale.noise[:, 0])
            log_w_next = log_w_next + np.logaddexp.reduce(log_p, axis=1)
            chosen = np.argmax(log_p + rng.gumbel(size=log_p.shape), axis=1)[:, None]
            noise, total, low, high = (
                np.take_along_axis(v, chosen, axis=1)[:, 0] for v in (noise, total, *off)
            )
            z = total * normal_between(low, high, rng.random(len(e)))[1]
        x = d**2 / total**2 * z + d * noise / total * rng.standard_normal(len(e))
        e[:, r] = x / d


def _prediction(
    scale: Scale,
    w: np.ndarray,
    center: np.ndarray,
    spread: np.ndarray,
    limits: np.ndarray,
    kind: int,
    case: int,
    y: float,
    rng: np.random.Generator,
) -> dict[str, Any]:
    """Prediction of a report that is N(center, spread^2) in each draw, before it is recorded."""
    off = (limits - center[:, None, None])[..., None]
    cut = np.diff(special.ndtr(off / spread[:, None, None]), axis=2)
    mass = w @ (cut[:, :, 0] @ scale.noise[:, 0])
    if scale.levels:
        mass = np.maximum(mass, 1e-300) / mass.sum()
        answers = np.arange(scale.levels) / (scale.levels - 1)
        at = np.searchsorted(np.cumsum(mass) - 1e-12, QUANTILES)
        found = {"mean": mass @ answers, "quantile": answers[np.minimum(at, len(mass) - 1)]}
        found["probability"] = mass
        return found | ({} if kind == NONE else {"log_score": np.log(mass[case])})
    spread = spread[:, 0]
    drawn = center + spread * rng.standard_normal(len(w))
    drawn, order = np.clip(drawn, 0.0, 1.0), np.argsort(drawn)
    at = np.searchsorted(np.cumsum(w[order]), QUANTILES)
    found = {"mean": w @ drawn, "quantile": drawn[order][np.minimum(at, len(w) - 1)]}
    if kind == NONE:
        return found
    if kind == GAUSSIAN:
        density = np.exp(-0.5 * ((y - center) / spread) ** 2) / (np.sqrt(2.0 * np.pi) * spread)
        return found | {"log_score": np.log(np.maximum(w @ density, 1e-300))}
    return found | {"log_score": np.log(np.maximum(mass[case], 1e-300))}


def _dataset(
    report: np.ndarray, out: dict[str, np.ndarray], scale: Scale, robots: Sequence[str]
) -> xr.Dataset:
    """Predictions by name, with their summaries as attributes."""
    axes = {"quantile": ("level",), "probability": ("answer",)}
    dims = ("mission", "bound", "robot")
    variables = {"report": (dims, report)}
    variables |= {name: ((*dims, *axes.get(name, ())), values) for name, values in out.items()}
    coords: dict[str, Any] = {
        "mission": np.arange(len(report)),
        "bound": np.arange(1, report.shape[1] + 1),
        "robot": list(robots),
        "level": list(QUANTILES),
    }
    if scale.levels:
        coords["answer"] = np.arange(1, scale.levels + 1)
    seen = ~np.isnan(report)
    low, middle, high = (out["quantile"][..., i][seen] for i in (0, 2, 4))
    attrs: dict[str, Any] = {"n": int(seen.sum())}
    if seen.any():
        attrs["mae"] = float(np.abs(report[seen] - middle).mean())
        attrs["mean_log_score"] = float(out["log_score"][seen].mean())
        attrs["coverage_90"] = float(((low <= report[seen]) & (report[seen] <= high)).mean())
    return xr.Dataset(variables, coords, attrs)


def draws_of(model: HumanTrust, sites: Mapping[str, np.ndarray]) -> tuple[Theta, np.ndarray]:
    """Hyperparameters and shared coefficients of draws by name."""
    theta = theta_of(sites, model.memory)
    names = ("beta0", "delta_w", "delta_v", "rest", *model.effect.names, *model.levels.names)
    shared = model.weights_of(sites["beta"], sites["b"])
    return {name: theta[name] for name in names}, shared
