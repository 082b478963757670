"""Trust in robots that operators report in a campaign, and the reports that are to be expected."""

from collections.abc import Sequence
from contextlib import suppress

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from trustbo.answers import answer_of
from trustbo.arrays import as_array, require_unit_interval
from trustbo.data import Mission
from trustbo.errors import PosteriorError, ShapeError, TrustboError, require_whole
from trustbo.inference.draws import is_of_people, sites_of
from trustbo.inference.fit import fit
from trustbo.inference.people import QUANTILES, draws_of, every_slot, model_of_people
from trustbo.inference.posterior_tree import require_posterior
from trustbo.inference.samplers.people import evidence_of
from trustbo.logs.reports import OUTCOMES, reports_of, scale_of
from trustbo.models.people import HumanTrust
from trustbo.stacking import stack_missions

_RETRIES = 2
_N_DRAWS = 1000
_PARTICLES = 8  # of trust after the last bound


def fit_reports(
    missions: Sequence[Mission], *, seed: int = 0, progress: bool = False
) -> xr.DataTree:
    """Posterior of the trust in robots that persons reported, given the contact of these.

    Reports depend on the missions through measured contact alone: the joint posterior of robots and
    persons is that of contact times this one, and so are their evidences. Each person's trust in
    each robot is a mission of `HumanTrust.of_operators`, see `logs.reports_of`; start, level and
    gains are partially pooled over all of these.

    Args:
        missions: Missions of one team, in order, see `Mission.with_reports`.
        seed: Seed; the same seed gives the same posterior.
        progress: Whether a slow fit shows its stages.

    Returns:
        Posterior as of `fit`, parameters and effects alone.

    Raises:
        TrustboError: No mission has reports, or they are on different scales.
        PosteriorError: The diagnostics are beyond their limits.
    """
    model = HumanTrust.of_operators(scale_of(missions))
    units = [*reports_of(missions).values()]
    for shift in range(_RETRIES):  # as in campaigns
        with suppress(PosteriorError):
            return fit(units, model, seed=seed + shift, progress=progress, whole=False)
    return fit(units, model, seed=seed + _RETRIES, progress=progress, whole=False)


def expect_reports(
    posterior: xr.DataTree, missions: Sequence[Mission], contact: ArrayLike, *, seed: int = 0
) -> xr.Dataset:
    """Reports to be expected of persons before the next mission, and after each of its bounds.

    Args:
        posterior: Posterior of `fit_reports`.
        missions: Missions that it was fitted to.
        contact: Contact rates of the bounds to come, (bound, robot), or draws of them, (draw,
            bound, robot), over which the reports are integrated.
        seed: Seed of the draws.

    Returns:
        Dataset over (person, bound, robot), bound 0 being before the mission: `mean` and `quantile`
        (also over `level`) of the report on the scale that was answered, such as 1 to 7, the `last`
        that was given, (person, robot), and with levels the `probability` of each `answer`.

    Raises:
        ShapeError: Contact of another shape.
        TrustboError: Contact outside [0, 1], or no posterior of `fit_reports`.
    """
    of_people = is_of_people(require_posterior("expect_reports", posterior))
    model = model_of_people(posterior) if of_people else None
    if model is None or model.names != OUTCOMES:
        raise TrustboError("expect_reports takes a posterior of fit_reports, or of its missions.")
    units, robots = reports_of(missions), missions[0].robots
    people = list(dict.fromkeys(person for person, _ in units))
    contact = as_array("contact", contact)
    if contact.ndim not in (2, 3) or contact.shape[-1] != len(robots):
        raise ShapeError(
            f"contact must be (bound, {len(robots)}), or (draw, bound, {len(robots)}); got "
            f"{contact.shape}."
        )
    contact = contact.reshape(-1, *contact.shape[-2:])
    require_unit_interval("contact", contact)
    rng = np.random.default_rng([require_whole("seed", seed, 0), 1])
    rates = contact[rng.integers(len(contact), size=_N_DRAWS)]
    reports = _drawn(model, posterior, [*units.values()], np.tile(rates, len(people)), rng)
    y = [unit.contact_rate[:, 0] for unit in units.values()]
    last = np.array([v[~np.isnan(v)][-1] if np.isfinite(v).any() else np.nan for v in y])
    shape = len(people), len(robots)
    by_person = reports.reshape(*reports.shape[:2], *shape).transpose(0, 2, 1, 3)
    dims, levels = ("person", "bound", "robot"), model.levels.levels
    by_person = answer_of(by_person, levels)
    variables = {
        "mean": (dims, by_person.mean(0)),
        "quantile": (("level", *dims), np.quantile(by_person, QUANTILES, axis=0)),
        "last": (("person", "robot"), answer_of(last.reshape(shape), levels)),
    }
    coords = {"person": people, "robot": list(robots), "level": list(QUANTILES)}
    coords["bound"] = list(range(reports.shape[1]))
    if levels:
        coords["answer"] = list(range(1, levels + 1))
        answered = [(np.round(by_person) == answer).mean(0) for answer in coords["answer"]]
        variables["probability"] = (("answer", *dims), np.array(answered))
    return xr.Dataset(variables, coords, {"scale": model.scale})


def _drawn(
    model: HumanTrust,
    posterior: xr.DataTree,
    units: Sequence[Mission],
    rates: np.ndarray,
    rng: np.random.Generator,
) -> np.ndarray:
    """Reports (draw, 1 + bound, unit) of a next mission of contact rates (draw, bound, unit)."""
    slots = every_slot(model, stack_missions(units, pad=False))
    asked = np.zeros(slots.y.shape, dtype=bool)
    last = np.array([len(unit.bounds) - 1 for unit in units])
    asked[np.arange(len(units)), last] = True
    evidence = evidence_of(model, slots, asked)
    theta, c = draws_of(model, sites_of(posterior))
    some = np.linspace(0, len(c) - 1, _N_DRAWS).astype(int)
    theta, c = {name: values[some] for name, values in theta.items()}, c[some]
    evidence.recentre({name: values.mean(0, keepdims=True) for name, values in theta.items()})
    x, _, own = evidence.given(theta, c, rng, _PARTICLES)
    x = x[:, evidence.at[1] == last[evidence.at[0]]]
    shared = model.shared(slots).name(c, theta, rng)
    base = shared["b"][:, None] + own[:, :, 1]
    z = np.stack([rates, 1.0 - rates], axis=-1)
    z = np.pad(z, ((0, 0), (1, 0), (0, 0), (0, 0)))  # nothing is seen before a mission
    moved = np.einsum("nkuf,nf->nku", z, shared["beta"])
    moved += np.einsum("nkuf,nuf->nku", model.effect.gains(z), own[:, :, 2:])
    # What beta0 carries on: the deviation from the base, or all.
    rest, carried = (base, 0.0) if model.memory == "deviation" else (0.0, base)
    trust = np.empty(moved.shape)
    for k in range(moved.shape[1]):
        w = theta["delta_w"][:, None] * rng.standard_normal(x.shape)
        x = rest + theta["beta0"][:, None] * (x - rest) + carried + moved[:, k] + w
        trust[:, k] = x
    noise = model.levels.draw_noise(trust.shape, rng) * theta["delta_v"][:, None, None]
    return model.levels.record(trust + noise, theta)
