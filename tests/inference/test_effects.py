"""An effect that this file defines, as CONTRIBUTING tells: from a fit to plans and files."""

import json
from dataclasses import dataclass
from typing import ClassVar

import jax
import numpy as np
import pytest
from missions import walking_missions
from references import dense_log_likelihood
from scipy import sparse

import trustbo as tb
from trustbo.data import Mission
from trustbo.errors import TrustboError
from trustbo.inference.posterior_groups import parameters_alone
from trustbo.models import PlaceEffect, PooledTrust, RobotEffect, TrustParams
from trustbo.models.effects import effect as effects
from trustbo.models.effects.effect import EFFECTS, Effect, Independent, register

FEATURES = ("line_of_sight", "slope")
HOURS = (0.0, 6.0, 12.0, 18.0, 21.0, 3.0, 12.0, 0.0, 12.0)  # the last is of the next mission
LIGHT = -0.4  # effect at noon


@register
@dataclass(frozen=True)
class Daylight(Effect):
    """Effect of the sun at the hour of each mission, and of the next, in proportion to sight."""

    hours: tuple[float, ...]
    tau_sun: float = 0.3
    names = ("tau_sun",)
    noun = "daylight"
    variables: ClassVar = {"sun_effect": ()}

    def height(self, n):
        """Height of the sun in the first missions, -1 to 1."""
        if n > len(self.hours):
            raise TrustboError(f"Daylight has {len(self.hours)} hours, of {n} missions.")
        return -np.cos(np.pi / 12.0 * np.array(self.hours[:n]))

    def group(self, slots):
        sun = self.height(slots.n_missions)[slots.mission]
        values = slots.line_of_sight * sun[:, None]
        return Independent(sparse.csr_array(values.reshape(-1, 1)), "sun_effect", "tau_sun")

    def ahead(self, values, theta, mission):
        sun = self.height(mission.n_before + 1)[-1]
        return mission.by_sight((theta["rest"] * values["sun_effect"] * sun)[:, None])


MODEL = PooledTrust(effects=[PlaceEffect(), RobotEffect(), Daylight(HOURS)])


@pytest.fixture(scope="module")
def missions():
    model, truth = PooledTrust(), TrustParams(0.2, np.array([0.7, 0.0]), 0.05, 0.03, 0.03)
    rng, missions = np.random.default_rng(0), []
    sun = -np.cos(np.pi / 12.0 * np.array(HOURS))
    for j, drawn in enumerate(walking_missions(1, 8, n_bounds=(6, 9))):
        z = drawn.awareness.copy()
        lit = z * np.array([1.0 + LIGHT * sun[j] * 0.8 / 0.7, 1.0])
        key = jax.random.key(int(rng.integers(1000)))
        rates = model.simulate(key, truth, lit[None]).contact_rate[0]
        rates = np.where(np.isnan(drawn.contact_rate), np.nan, np.clip(rates, 0.0, 1.0))
        missions.append(Mission.from_arrays(drawn.path, z, rates, features=FEATURES))
    return missions


@pytest.fixture(scope="module")
def posterior(missions):
    return tb.fit(missions, MODEL, draws=100, seed=1, progress=False)


def test_its_effect_is_found(posterior):
    effect = posterior["daylight"]["sun_effect"]
    assert effect.dims == ("chain", "draw")
    assert abs(float(effect.mean()) - LIGHT) < 3.0 * float(effect.std())
    assert float(effect.std()) < 0.1
    assert float(posterior["posterior"]["tau_sun"].mean()) > 0.1
    assert "tau_sun" in posterior["prior"]
    assert "tau_sun" in posterior["log_prior"]
    assert "sun_effect" not in posterior["posterior"]


def test_likelihoods_of_fitted_missions_have_it(missions):
    model = PooledTrust(effects=Daylight(HOURS))
    posterior = tb.fit(missions, model, draws=25, progress=False)
    draws = posterior["posterior"].isel(chain=0, draw=7)
    beta0, light = float(draws["beta0"]), float(posterior["daylight"]["sun_effect"][0, 7])
    for j, mission in enumerate(missions):
        beta, expected = draws["beta"].values.copy(), 0.0
        beta[0] += (1.0 - beta0) * light * -np.cos(np.pi / 12.0 * HOURS[j])
        for i in range(3):
            z, y = mission.awareness[:, i], mission.contact_rate[:, i]
            noises = float(draws["delta_w"]), float(draws["delta_v"])
            expected += dense_log_likelihood(
                beta0, beta, float(draws["b"]), *noises, 0.5, 0.5, z, y
            )
        found = posterior["log_likelihood"]["contact_rate"].values[0, 7, j]
        np.testing.assert_allclose(found, expected, rtol=1e-8)


def test_plans_have_that_of_the_next_mission(posterior, missions):
    """That of noon, against a night of the same length otherwise."""
    noon = tb.inference.params_of(posterior)
    at_night = PooledTrust(effects=[PlaceEffect(), RobotEffect(), Daylight((*HOURS[:8], 0.0))])
    posterior = tb.fit(missions, at_night, draws=100, seed=1, progress=False, whole=False)
    night = tb.inference.params_of(posterior)
    beta0 = posterior["posterior"]["beta0"].values.reshape(-1, 1)
    light = posterior["daylight"]["sun_effect"].values.reshape(-1, 1)
    np.testing.assert_allclose(
        noon.beta[:, :, 0] - night.beta[:, :, 0],
        np.repeat(2.0 * (1.0 - beta0) * light, 3, axis=1),
        rtol=1e-9,
    )
    np.testing.assert_array_equal(noon.beta[:, :, 1], night.beta[:, :, 1])


def test_a_posterior_of_it_is_read_from_a_file(posterior, missions, tmp_path):
    alone = parameters_alone(posterior)
    assert "daylight" in alone.children
    alone.to_netcdf(tmp_path / "posterior.nc")
    again = tb.inference.posterior_tree.xr.open_datatree(tmp_path / "posterior.nc")
    for name, values in tb.inference.params_of(posterior).by_name.items():
        np.testing.assert_array_equal(tb.inference.params_of(again).by_name[name], values)
    whole = tb.inference.complete(again, missions)
    np.testing.assert_array_equal(whole["latent"]["trust_mean"], posterior["latent"]["trust_mean"])
    again.close()


def test_a_campaign_learns_it_plans_with_it_and_goes_on(tmp_path):
    z = np.random.default_rng(2).uniform(size=(3, 5, 5, 2))
    workspace = tb.Workspace.from_awareness(z, features=FEATURES)
    truth = TrustParams(0.2, np.array([0.7, 0.0]), 0.05, 0.03, 0.03)
    simulator = tb.simulation.ModelSimulator(workspace, truth)
    options = {"simulator": simulator, "progress": False, "seed": 3, "directory": tmp_path}
    tb.iterate(workspace, (4, 0), (0, 4), n_iterations=2, model=MODEL, **options)
    del options["directory"], options["seed"]
    result = tb.resume(tmp_path, n_iterations=3, **options)
    assert all("daylight" in tree.children for tree in result.posteriors)
    assert result.posteriors[-1].attrs["n_missions"] == 3


def test_censored_rates_take_it(missions):
    censored = PooledTrust(effects=Daylight(HOURS), observation="censored")
    effect = tb.fit(missions, censored, draws=100, whole=False)["daylight"]["sun_effect"]
    assert abs(float(effect.mean()) - LIGHT) < 4.0 * float(effect.std())


@pytest.mark.slow
def test_nuts_takes_it(missions):
    run = {"n_chains": 2, "warmup": 100, "draws": 300, "check": False, "whole": False}
    model = PooledTrust(effects=Daylight(HOURS))
    nuts, exact = (
        tb.fit(missions, model, sampler, progress=False, **options)["daylight"]["sun_effect"]
        for sampler, options in (("nuts", run), ("exact", {"whole": False}))
    )
    # Of 300 effective draws at least: 4 standard errors of the mean.
    assert abs(float(nuts.mean() - exact.mean())) < 4.0 / np.sqrt(300.0) * float(exact.std())


def test_what_cannot_treat_it_refuses_it_by_its_noun(missions):
    censored = PooledTrust(effects=Daylight(HOURS), observation="censored")
    with pytest.raises(TrustboError, match=r'"nuts" cannot treat.*observations are not Gaussian'):
        tb.fit(missions, censored, "nuts")
    with pytest.raises(TrustboError, match="effects of daylight are of fitted missions"):
        tb.inference.prior_predictive(PooledTrust(effects=Daylight(HOURS)), np.ones((1, 2, 3, 2)))
    with pytest.raises(TrustboError, match="Daylight has 1 hours, of 8 missions"):
        tb.fit(missions, PooledTrust(effects=Daylight((12.0,))))


def test_an_effect_can_be_compared():
    assert hash(Daylight([12.0, 0.0])) == hash(Daylight((12.0, 0.0)))


def test_ranks_of_its_calibration_are_those_of_its_variable():
    model = PooledTrust(effects=Daylight((0.0, 12.0, 18.0)))
    result = tb.inference.sbc(model, n_datasets=3, shape=(3, 4, 2, 2), progress=False)
    assert {"tau_sun", "sun_effect[0]"} <= set(result["parameter"].values)


def test_a_process_without_its_module_refuses_the_posterior(posterior, monkeypatch):
    assert json.loads(posterior.attrs["model_record"])["effects"][1]["kind"] == "Daylight"
    monkeypatch.setattr(effects, "EFFECTS", {})
    kinds = {name: kind for name, kind in EFFECTS.items() if name != "Daylight"}
    monkeypatch.setattr("trustbo.models.record.EFFECTS", kinds)
    with pytest.raises(TrustboError, match="'Daylight', which this process does not have"):
        tb.inference.params_of(posterior)


def test_an_effect_with_the_names_of_another_is_refused():
    with pytest.raises(TrustboError, match="Shadows has 'robots', which another has"):
        register(type("Shadows", (Daylight,), {"noun": "robots"}))
    with pytest.raises(TrustboError, match="Nameless needs a noun"):
        register(type("Nameless", (Daylight,), {"noun": ""}))
    assert "Shadows" not in EFFECTS
