"""HumanTrust: dense references, effects found, predictions, likelihoods of persons, refusals."""

import dataclasses
import itertools
from dataclasses import replace

import numpy as np
import numpyro.distributions as dist
import pytest
from scipy import stats

import trustbo as tb
from trustbo.errors import TrustboError
from trustbo.inference import fit, loo, predict_reports, sbc
from trustbo.inference.people import draw_people, model_of_people
from trustbo.inference.prior_predictive import draw_sites
from trustbo.inference.samplers.people import evidence_of
from trustbo.models import HumanTrust, PersonEffect
from trustbo.models.effects.effect import Slots
from trustbo.models.record import model_from_record, model_to_record
from trustbo.stacking import MissionBatch, stack_missions

FEATURES = ("success", "failure", "need")
LOGISTIC = stats.logistic(scale=np.sqrt(3.0) / np.pi)  # of sd 1
THETA = {
    "beta0": 0.7, "delta_w": 0.05, "delta_v": 0.1, "rest": 1.0, "tau_start": 0.15,
    "tau_level": 0.1, "tau_gain": 0.12, "cut_1": 0.4, "cut_2": -0.3, "cut_3": 0.2, "cut_4": 0.1,
}  # fmt: skip


def people_of(y, z, levels=7):
    """Missions of reports (person, step) and features (person, step, feature)."""
    ticks = np.full((y.shape[1], 1), levels - 1.0 if levels else np.nan)
    return [
        tb.Mission.from_arrays(None, a[:, None], b[:, None], n_ticks=ticks, features=FEATURES)
        for a, b in zip(z, y, strict=True)
    ]


def outcomes(n, steps, seed=0):
    """Features of n persons: an outcome at each step but the first, and a constant."""
    rng = np.random.default_rng(seed)
    success = (rng.random((n, steps)) < 0.5).astype(float)
    z = np.stack([success, 1.0 - success, np.zeros((n, steps))], axis=-1)
    z[:, 0, :2], z[:, :, 2] = 0.0, rng.random((n, 1))
    return z


def simulated(n=40, steps=6, scale="likert7", seed=0, **truth):
    """Persons drawn from the model at THETA with gains .15 and -.3."""
    model = HumanTrust(scale=scale).for_features(FEATURES)
    z = outcomes(n, steps, seed)
    batch = MissionBatch(z[:, :, None], np.zeros((n, steps, 1)), np.full((n, steps, 1), 6.0))
    sites = {name: np.array([value]) for name, value in (THETA | truth).items()}
    sites |= {"beta": np.array([[0.15, -0.3, -0.1]]), "b": np.array([0.6])}
    slots = Slots.every(batch, n, FEATURES, None)
    drawn = draw_people(model, slots, sites, np.random.default_rng(seed))
    return people_of(drawn["contact_rate"][0, :, :, 0], z, 0 if scale == "unit" else 7)


@pytest.fixture(scope="module")
def persons():
    return simulated()


@pytest.fixture(scope="module")
def posterior(persons):
    return fit(persons, HumanTrust(scale="likert7"), progress=False)


def joint_of(model, z):
    """Mean and covariance of trust of persons (person, step, ...), everything integrated out."""
    n, K = z.shape[:2]
    level, t = model.memory == "level", THETA
    lag = np.array([[t["beta0"] ** (k - j) if j <= k else 0.0 for j in range(K)] for k in range(K)])
    rest = 1.0 - t["beta0"] if level else 1.0
    columns = np.concatenate([z, np.ones((n, K, 1))], axis=-1)
    mean_c, sd_c = np.array([0.0, 0.0, 0.0, 0.5]), np.array([0.3, 0.3, 0.3, 0.5])
    carried = np.array([True, True, level, level])
    V = np.where(carried, np.einsum("kj,njc->nkc", lag, columns), columns).reshape(n * K, -1)
    if not model.asymmetric:
        V = np.column_stack([V[:, 0] - V[:, 1], V[:, 2:]])
        mean_c, sd_c = mean_c[1:], sd_c[1:]
    cov = np.kron(np.eye(n), t["delta_w"] ** 2 * lag @ lag.T) + (V * sd_c**2) @ V.T
    for i in range(n):
        start, constant = np.eye(K)[0], np.ones(K)
        own = [(t["tau_start"], lag @ start)]
        if model.persons:
            own += [(rest * t["tau_level"], lag @ constant if level else constant)]
            gains = [z[i, :, 0], z[i, :, 1]]
            gains = gains if model.asymmetric else [gains[0] - gains[1]]
            own += [(t["tau_gain"], lag @ gain) for gain in gains]
        rows = slice(i * K, i * K + K)
        for sd, column in own:
            cov[rows, rows] += sd**2 * np.outer(column, column)
    return V @ mean_c, cov


def evidence_at_theta(model, people):
    slots = Slots.of(stack_missions(people, pad=False), len(people), FEATURES)
    evidence = evidence_of(model, slots)
    theta = {name: np.array([value]) for name, value in THETA.items()}
    theta["rest"] = np.array([0.3 if model.memory == "level" else 1.0])
    for _ in range(3):
        evidence.recentre(theta)
    return evidence, theta


@pytest.mark.parametrize("memory", ["deviation", "level"])
@pytest.mark.parametrize("asymmetric", [True, False])
@pytest.mark.parametrize("persons", [True, False])
def test_the_density_of_numbers_is_that_of_the_dense_joint_normal(memory, asymmetric, persons):
    model = HumanTrust(memory=memory, asymmetric=asymmetric, persons=persons)
    model, z = model.for_features(FEATURES), outcomes(3, 4)
    y = np.random.default_rng(1).uniform(0.05, 0.95, (3, 4))
    y[0, 1] = y[2, 3] = np.nan
    seen = ~np.isnan(y.ravel())
    mean, cov = joint_of(model, z)
    law = stats.multivariate_normal(mean[seen], (cov + 0.01 * np.eye(12))[np.ix_(seen, seen)])
    evidence, theta = evidence_at_theta(model, people_of(y, z, 0))
    assert evidence.exact
    np.testing.assert_allclose(evidence.log_density(theta), law.logpdf(y.ravel()[seen]), rtol=1e-9)


@pytest.mark.parametrize("scale", ["likert7", "ordinal7"])
def test_the_density_of_levels_is_that_of_boxes_of_the_dense_joint_normal(scale):
    """Two persons of two reports: a box of trust plus noise in each logistic component."""
    model, z = HumanTrust(scale=scale).for_features(FEATURES), outcomes(2, 2, seed=3)
    y = np.array([[2.0, 5.0], [6.0, 3.0]]) / 6.0
    mean, cov = joint_of(model, z)
    cuts = model.levels.cuts({name: np.array([value]) for name, value in THETA.items()})[0]
    edges = np.concatenate([[-9.0], cuts, [9.0]])
    level = np.round(y.ravel() * 6.0).astype(int)
    total = 0.0
    for parts in itertools.product(model.levels.noise, repeat=4):
        weights, sds = np.array(parts).T
        law = stats.multivariate_normal(mean, cov + np.diag((0.1 * sds) ** 2), seed=0, maxpts=4000)
        total += weights.prod() * law.cdf(edges[level + 1], lower_limit=edges[level])
    people = people_of(y, z)
    evidence, theta = evidence_at_theta(model, people)
    found = evidence.log_density(theta)[0]
    assert abs(found - np.log(total)) < 0.02  # expectation propagation's own error
    _, log_weight = evidence.draw(theta, np.array([4000]), np.random.default_rng(0))
    estimate = np.exp(log_weight - np.log(total))
    # The weights are unbiased whatever EP says: 4 standard errors, and 1e-3 of the boxes.
    assert abs(estimate.mean() - 1.0) < 4.0 * estimate.std() / np.sqrt(4000) + 2e-3


def test_noise_of_levels_is_logistic():
    scale = HumanTrust(scale="likert7").levels
    x = np.linspace(-6.0, 6.0, 101)
    mixture = stats.norm.cdf(x[:, None] / scale.noise[:, 1]) @ scale.noise[:, 0]
    np.testing.assert_allclose(mixture, LOGISTIC.cdf(x), atol=1e-3)
    drawn = scale.draw_noise((20_000,), np.random.default_rng(0))
    assert stats.kstest(drawn, LOGISTIC.cdf).pvalue > 1e-3


def test_gains_are_found_and_persons_differ(posterior):
    assert posterior.attrs["k_hat"] < 0.7
    draws = posterior["posterior"].to_dataset()
    for name, at, truth in (("beta", 0, 0.15), ("beta", 1, -0.3), ("tau_gain", None, 0.12)):
        values = draws[name].values.reshape(4000, -1)[:, at or 0]
        assert abs(values.mean() - truth) < 3.0 * values.std(), name
    assert (draws["beta"][..., 1] < -draws["beta"][..., 0]).mean() > 0.9  # failures weigh more


@pytest.mark.slow
def test_parts_of_the_model_pay_by_leave_one_person_out(persons, posterior):
    whole = loo(posterior)
    for less in (HumanTrust(scale="likert7", persons=False),
                 HumanTrust(scale="likert7", asymmetric=False)):  # fmt: skip
        tree = fit(persons, less, progress=False)
        assert whole.elpd > loo(tree).elpd


def test_memory_of_people_is_weighed_by_their_evidence(persons, posterior):
    """Against a model whose prior has beta0 at most .001, by evidence with errors of some .1."""
    found = tb.inference.memory(posterior)
    priors = replace(HumanTrust().priors, beta0=dist.Beta(1.0, 1e4))
    none = fit(persons, HumanTrust(priors, scale="likert7"), whole=False, progress=False)
    without = posterior.attrs["log_evidence"] - none.attrs["log_evidence"]
    assert found.log_bf == pytest.approx(without, abs=0.5)
    assert found.log_bf > 5.0


def test_persons_left_out_have_even_weights(posterior):
    assert (loo(posterior).pareto_k < 0.7).all()


def test_a_person_left_out_is_an_integral_over_the_person_s_own_part(persons, posterior):
    """Log likelihoods of a draw, estimated anew: the evidence of one person at that draw."""
    model = model_of_people(posterior)
    some = persons[:3]
    slots = Slots.of(stack_missions(some, pad=False), 3, FEATURES)
    sites = {n: a.values[0, :5] for n, a in posterior["posterior"].to_dataset().items()}
    theta = {name: sites[name] for name in sites if name != "beta"} | {"rest": np.ones(5)}
    evidence = evidence_of(model, slots)
    evidence.recentre({name: values[:1] for name, values in theta.items()})
    shared = model.weights_of(sites["beta"], sites["b"])
    _, found, _ = evidence.given(theta, shared, np.random.default_rng(0), 400)
    kept = posterior["log_likelihood"]["contact_rate"].values[0, :5, :3]
    # Eight particles a person, 400 here: a few hundredths of a nat.
    assert np.abs(found - kept).max() < 0.25
    assert np.abs(found - kept).mean() < 0.05


def test_predictions_are_conditional_frequencies(posterior):
    """One draw of the posterior, repeated; many persons of the same first two reports."""
    one = posterior.copy()
    fixed = {n: a.isel(chain=[0], draw=[7]) for n, a in one["posterior"].to_dataset().items()}
    tree = posterior["posterior"].to_dataset()
    repeated = {n: (tree[n].dims, np.broadcast_to(a.values, tree[n].shape))
                for n, a in fixed.items()}  # fmt: skip
    one["posterior"] = tb.inference.people.xr.DataTree(tree.assign(repeated))
    z, y = outcomes(1, 3, seed=5), np.array([[3.0, 4.0, np.nan]]) / 6.0
    found = predict_reports(one, people_of(y, z), n_draws=4000)["probability"].values[0, 2, 0]
    model, n = model_of_people(posterior), 150_000
    sites = {name: a.values[0] for name, a in fixed.items()}
    batch = MissionBatch(
        np.repeat(z[:, :, None], n, 0), np.zeros((n, 3, 1)), np.full((n, 3, 1), 6.0)
    )
    slots = Slots.every(batch, n, FEATURES, None)
    drawn = draw_people(model, slots, sites, np.random.default_rng(1))["contact_rate"][0, :, :, 0]
    alike = (np.abs(drawn[:, :2] - y[0, :2]) < 1e-9).all(1)
    expected = np.bincount(np.round(drawn[alike, 2] * 6).astype(int), minlength=7) / alike.sum()
    # Weights of 4000 particles have an effective number of 1000 at least.
    se = np.sqrt(expected * (1 - expected) * (1.0 / alike.sum() + 1e-3))
    assert alike.sum() > 300
    assert (np.abs(found - expected) < 4.0 * se + 1e-3).all()


def test_own_reports_help_and_reports_may_come_at_the_end_only(persons, posterior):
    with_own = predict_reports(posterior, persons)
    answers = np.array([1.0 + 6.0 * mission.contact_rate for mission in persons])
    np.testing.assert_allclose(with_own["report"], answers)  # on the scale that was answered
    mean = with_own["probability"].dot(with_own["answer"])
    np.testing.assert_allclose(with_own["mean"], mean, atol=1e-6)  # answers have six places
    without = predict_reports(posterior, persons, given="none")
    assert with_own.attrs["mae"] < without.attrs["mae"]
    assert with_own.attrs["mean_log_score"] > without.attrs["mean_log_score"]
    np.testing.assert_allclose(with_own["probability"].sum("answer"), 1.0)
    assert 0.8 < with_own.attrs["coverage_90"]
    late = []
    for mission in persons:
        y = mission.contact_rate.copy()
        y[:-1] = np.nan
        late.append(tb.Mission.from_arrays(None, mission.awareness, y, n_ticks=mission.n_ticks,
                                           features=FEATURES))  # fmt: skip
    late = [dataclasses.replace(mission, scale="likert7") for mission in late]
    tree = fit(late, progress=False)  # of `HumanTrust`, as these are reports
    assert (tree.attrs["model"], tree.attrs["scale"]) == ("HumanTrust", "likert7")
    assert np.isfinite(tree["latent"]["trust_mean"].values).all()
    gains = tree["posterior"]["beta"].mean(("chain", "draw")).values
    assert gains[0] > gains[1]


def test_a_posterior_is_kept_in_a_file(posterior, tmp_path):
    posterior.to_netcdf(tmp_path / "people.nc")
    read = tb.inference.people.xr.open_datatree(tmp_path / "people.nc")
    assert model_of_people(read).describe() == model_of_people(posterior).describe()
    assert "log_prior" in posterior.children
    assert set(posterior["persons"]["part"].values) == {"start", "level", "success", "failure"}


@pytest.mark.parametrize("memory", ["deviation", "level"])
def test_a_model_comes_back_from_its_record(memory):
    model = HumanTrust(memory=memory).for_features(FEATURES)
    assert model_from_record(model_to_record(model)) == model


def test_numbers_at_the_ends_are_limits():
    people = simulated(n=20, scale="unit", seed=4)
    tree = fit(people, HumanTrust(), progress=False)
    found = predict_reports(tree, people)
    assert found.attrs["mae"] < 0.15
    assert np.isfinite(found["log_score"].values).all()


def test_ranks_of_people_are_of_the_model_s_parameters():
    model = HumanTrust(scale="ordinal7").for_features(("success", "failure"))
    found = sbc(model, n_datasets=2, shape=(4, 3, 1, 2), progress=False)
    names = {str(name) for name in found["parameter"].values}
    assert {"beta0", "tau_gain", "cut_4", "beta[1]", "person[0]"} <= names


def test_prior_draws_of_symmetric_gains_are_opposite():
    model = HumanTrust(asymmetric=False).for_features(FEATURES)
    sites = draw_sites(model, (1, 3), 50, 0)
    np.testing.assert_allclose(sites["beta"][:, 0], -sites["beta"][:, 1])
    assert model.describe().count("asymmetric") == 2  # the model's, and its effect's


def test_the_model_refuses_what_it_is_not_for(posterior, persons):
    with pytest.raises(TrustboError, match='scale must be "unit", "likert7" or "ordinal7"'):
        HumanTrust(scale="stars")
    with pytest.raises(TrustboError, match="effects of persons alone"):
        HumanTrust(effects=[tb.models.RobotEffect()])
    with pytest.raises(TrustboError, match="persons must be True or False; got 'no'"):
        HumanTrust(persons="no")
    with pytest.raises(TrustboError, match=r"PersonEffect\.tau_gain"):
        PersonEffect(tau_gain=0.0)
    with pytest.raises(TrustboError, match="on 5 levels, but the missions' are on 7 levels"):
        fit(persons, HumanTrust(scale="likert5"), progress=False, whole=False)
    with pytest.raises(TrustboError, match=r"in \[0, 1\], but the missions' are on 7 levels"):
        fit(persons, HumanTrust(), progress=False, whole=False)
    with pytest.raises(TrustboError, match="criticise is of robots' contact; of reports"):
        tb.criticise(posterior, persons)
    with pytest.raises(TrustboError, match=r"for reports use trustbo\.inference\.predict_reports"):
        tb.inference.params_of(posterior)
    with pytest.raises(TrustboError, match="HumanTrust has no likelihoods of parameters"):
        HumanTrust().log_likelihood(tb.models.TrustParams(0.5, np.zeros(3), 0.1, 0.1, 0.1), persons)
    with pytest.raises(TrustboError, match="HumanTrust has no missions simulated"):
        HumanTrust().simulate(None, None, np.zeros((1, 1, 1, 3)))
    with pytest.raises(TrustboError, match="HumanTrust has no numpyro model"):
        HumanTrust()(np.zeros((1, 1, 1, 3)))
    terrain = tb.terrain.synthetic_terrain((90.0, 90.0), seed=5)
    workspace = tb.Workspace.from_terrain(terrain, (3, 3))
    with pytest.raises(TrustboError, match="HumanTrust is of reports of people, and plans no"):
        tb.Campaign(workspace, (2, 0), (0, 2), model=HumanTrust())
    ticks = np.full((2, 1), 6.0)
    other = tb.Mission.from_arrays(None, np.zeros((2, 1, 1)), [[0.5], [0.5]], n_ticks=ticks)
    with pytest.raises(TrustboError, match="the posterior has inputs"):
        predict_reports(posterior, [other])
    pooled = fit(persons, progress=False, whole=False)
    with pytest.raises(TrustboError, match="takes a posterior of HumanTrust; got one of Pooled"):
        predict_reports(pooled, persons)
