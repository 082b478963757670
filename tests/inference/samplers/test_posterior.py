"""Draws of scores under the Gaussian evidence against quadrature and many wide points."""

import numpy as np
import pytest
from missions import simulate_missions, walking_missions
from references import pooled_posterior

from trustbo.inference.evidence.gaussian import Gaussian
from trustbo.inference.samplers.importance import sample_scores
from trustbo.inference.samplers.posterior import Posterior
from trustbo.inference.samplers.scores import Scores
from trustbo.models import Priors
from trustbo.models.effects.effect import Slots
from trustbo.models.effects.place import PlaceEffect
from trustbo.models.effects.robot import RobotEffect
from trustbo.models.effects.weights import Weights
from trustbo.models.place import bounds_of, visited
from trustbo.stacking import stack_missions


def posterior_of(missions, effects, priors):
    batch = stack_missions(missions)
    places = visited(bounds_of(missions, batch.contact_rate.shape[:2]), PlaceEffect(), 3)
    slots = Slots.of(batch, len(missions), ("line_of_sight", "slope"), None, places)
    effects = [Weights(priors), *effects]
    x0 = float(priors.x0_mean), float(priors.x0_sd)
    evidence = Gaussian(slots, [effect.group(slots) for effect in effects], x0)
    return Posterior(Scores(priors, effects), evidence, float(np.nanstd(slots.y)))


def test_pooled_draws_are_those_of_a_quadrature():
    missions = simulate_missions(6, 1)
    target = posterior_of(missions, [], Priors())
    target.n_final = 4096
    drawn = sample_scores(target, 4000, 0).draws
    on_grid, (mean, sd, weight) = pooled_posterior(missions)
    moments = {
        name: (share @ points, np.sqrt(share @ points**2 - (share @ points) ** 2))
        for name, (points, share) in zip(("beta0", "delta_w", "delta_v"), on_grid, strict=True)
    }
    ours = dict(drawn.params)
    for m in range(3):
        centre = (weight * mean[..., m]).sum()
        spread = np.sqrt((weight * (sd[..., m] ** 2 + (mean[..., m] - centre) ** 2)).sum())
        moments[f"c{m}"] = centre, spread
        ours[f"c{m}"] = np.column_stack([ours["beta"], ours["b"]])[:, m]
    for name, (centre, spread) in moments.items():
        # Kish size > 2000: three standard errors of .022 sd and 1.6 %.
        assert abs(ours[name].mean() - centre) < 0.066 * spread, name
        assert abs(np.log(ours[name].std() / spread)) < 0.048, name


@pytest.fixture(scope="module")
def whole():
    """Posterior of places and robots."""
    return posterior_of(
        walking_missions(0, 6), [PlaceEffect(), RobotEffect()], Priors.of(("line_of_sight",))
    )


def test_draws_of_places_and_robots_are_those_of_many_wide_points(whole):
    found = sample_scores(whole, 1000, 0)
    assert found.draws.khat < 0.7
    wide = found.proposal.widened(1.4)
    z = wide.draw(2**13, 5)
    log_w = whole.log_density(z) - wide.log_density(z)
    w = np.exp(log_w - log_w.max())
    evidence = log_w.max() + np.log(w.mean())
    w /= w.sum()
    theta = whole.scores.theta(z)
    # Kish sizes of 200 and more: four standard errors of the mean, five of the sd.
    assert 1.0 / (w**2).sum() > 1000.0
    assert found.draws.kish > 200.0
    for name in ("beta0", "delta_w", "delta_v", "tau_s", "tau_e", "tau_slow", "tau_day"):
        mean = w @ theta[name]
        sd = np.sqrt(w @ (theta[name] - mean) ** 2)
        assert abs(found.draws.params[name].mean() - mean) < 0.3 * sd, name
        assert abs(np.log(found.draws.params[name].std() / sd)) < 0.25, name
    assert abs(found.draws.log_evidence - evidence) < 0.3


def test_draws_have_an_effect_of_each_mission_robot_cell_and_bound(whole):
    drawn = sample_scores(whole, 30, 0).draws.params
    places = whole.evidence.slots.places
    assert drawn["robot_effect"].shape == (30, 6, 3)
    assert drawn["place"].shape == (30, len(places.cells))
    assert drawn["place_bound"].shape == (30, len(places.units))
    assert drawn["beta"].shape == (30, 2)
    assert set(drawn) >= {"tau_s", "length_scale", "tau_e", "tau_slow", "tau_day", "b"}
