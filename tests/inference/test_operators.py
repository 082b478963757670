"""Trust that operators report: dense references, a gain that is found, reports to be expected."""

import numpy as np
import pytest
from scipy import stats

import trustbo as tb
from trustbo.errors import ShapeError, TrustboError
from trustbo.inference import expect_reports, fit, fit_reports
from trustbo.inference.samplers.people import evidence_of
from trustbo.models import HumanTrust
from trustbo.models.effects.effect import Slots
from trustbo.stacking import stack_missions

GAINS = (0.1, -0.2)
THETA = {
    "beta0": 0.8, "delta_w": 0.03, "delta_v": 0.05, "rest": 1.0, "tau_start": 0.15,
    "tau_level": 0.1, "tau_gain": 0.05,
}  # fmt: skip
N_OWN = 4  # start, level, gains


def campaign(n_missions, *, n_bounds=6, seed=0, every=True):
    """Missions of two robots of different contact, with reports of one who sees it."""
    rng = np.random.default_rng(seed)
    trust, missions = np.full(2, 0.6), []
    for _ in range(n_missions):
        c = np.clip(rng.uniform(0.1, 1.0, 2) + 0.15 * rng.standard_normal((n_bounds, 2)), 0, 1)
        trust = 0.6 + 0.8 * (trust - 0.6)  # the step before a mission
        answers = np.full((1 + n_bounds, 2), np.nan)
        for k in range(n_bounds):
            moved = GAINS[0] * c[k] + GAINS[1] * (1.0 - c[k])
            trust = 0.6 + 0.8 * (trust - 0.6) + moved + 0.02 * rng.standard_normal(2)
            if every or k == n_bounds - 1:
                answers[k + 1] = np.clip(trust + 0.04 * rng.standard_normal(2), 0.0, 1.0)
        path = [(0, k) for k in range(n_bounds + 1)]
        made = tb.Mission.from_arrays(path, np.full((n_bounds, 2, 1), 0.5), c)
        missions.append(made.with_reports(answers))
    return missions


def sources(missions, memory):
    """Trust of robots after each step as a linear map of independent standard normals.

    Rows (robot, step); columns are the mean, gains and base shared by all, own parts of each robot,
    and a shock at each step.
    """
    t, rows = THETA, []
    steps = sum(1 + len(mission.bounds) for mission in missions)
    n_columns = 1 + 3 + 2 * N_OWN + 2 * steps
    for i in range(2):
        deviation, k = np.zeros(n_columns), 0
        for mission in missions:
            for rate in (None, *mission.contact_rate[:, i]):
                inputs = np.array([0.0, 0.0] if rate is None else [rate, 1.0 - rate])
                base, impulse = np.zeros((2, n_columns))
                base[[0, 3]] = 0.5, 0.5
                own = 4 + N_OWN * i
                base[own + 1] = t["tau_level"] * (0.2 if memory == "level" else 1.0)
                impulse[[1, 2]] = 0.3 * inputs
                impulse[own] = t["tau_start"] * (k == 0)
                impulse[[own + 2, own + 3]] = t["tau_gain"] * inputs
                impulse[4 + 2 * N_OWN + i * steps + k] = t["delta_w"]
                if memory == "level":
                    impulse, base = impulse + base, np.zeros(n_columns)
                deviation = t["beta0"] * deviation + impulse
                rows.append(base + deviation)
                k += 1
    return np.array(rows)


@pytest.mark.parametrize("memory", ["deviation", "level"])
def test_the_evidence_of_reports_is_that_of_the_dense_joint_normal(memory):
    missions = campaign(2, n_bounds=3)
    units = [*tb.logs.reports_of(missions).values()]
    rows = sources(missions, memory)
    y = np.concatenate([unit.contact_rate[:, 0] for unit in units])
    seen = ~np.isnan(y)
    cov = rows[:, 1:] @ rows[:, 1:].T + THETA["delta_v"] ** 2 * np.eye(len(y))
    law = stats.multivariate_normal(rows[seen, 0], cov[np.ix_(seen, seen)])
    model = HumanTrust(memory=memory).for_features(("success", "failure"))
    slots = Slots.of(stack_missions(units, pad=False), len(units), units[0].features)
    theta = {name: np.array([value]) for name, value in THETA.items()}
    theta["rest"] = np.array([0.2 if memory == "level" else 1.0])
    found = evidence_of(model, slots).log_density(theta)
    np.testing.assert_allclose(found, law.logpdf(y[seen]), rtol=1e-9)


@pytest.fixture(scope="module")
def missions():
    return campaign(8)


@pytest.fixture(scope="module")
def posterior(missions):
    return fit_reports(missions)


def test_the_gain_of_a_simulated_operator_is_found(posterior):
    beta = posterior["posterior"]["beta"].values.reshape(-1, 2)
    gain = beta[:, 0] - beta[:, 1]
    assert abs(gain.mean() - 0.3) < 2.5 * gain.std()
    assert (gain > 0.0).mean() > 0.95
    assert abs(float(posterior["posterior"]["beta0"].mean()) - 0.8) < 0.1


def test_memory_is_weighed_of_reports_as_of_contact(posterior, missions):
    found = tb.inference.memory(posterior)
    assert tb.inference.memory(posterior, missions) == found
    assert found.p_none < 0.05  # beta0 is .8


@pytest.mark.parametrize("memory", ["deviation", "level"])
def test_expected_reports_are_those_of_the_dense_conditional_normal(memory):
    """At one draw of what persons share, repeated: own parts and trust given the reports."""
    told = campaign(3, n_bounds=3, seed=2)
    units = [*tb.logs.reports_of(told).values()]
    tree = fit(units, HumanTrust(memory=memory), whole=False, progress=False, check=False)
    values = {"beta0": 0.8, "b": 0.6, "delta_w": 0.03, "delta_v": 0.05, "beta": np.array(GAINS)}
    values["b"] = 0.12 if memory == "level" else 0.6
    values |= {name: THETA[name] for name in ("tau_start", "tau_level", "tau_gain")}
    drawn = tree["posterior"].to_dataset()
    fixed = {n: (drawn[n].dims, np.broadcast_to(v, drawn[n].shape)) for n, v in values.items()}
    one = tree.copy()
    one["posterior"] = tb.inference.people.xr.DataTree(drawn.assign(fixed))
    ahead = np.array([[0.7, 0.6], [0.8, 0.7]])
    found = expect_reports(one, told, ahead, seed=3)

    extended = tb.Mission.from_arrays([(0, k) for k in range(3)], np.full((2, 2, 1), 0.5), ahead)
    rows = sources([*told, extended], memory)
    mean = rows[:, :4] @ [1.0, GAINS[0] / 0.3, GAINS[1] / 0.3, (values["b"] - 0.5) / 0.5]
    n = len(rows) // 2
    for i, unit in enumerate(units):
        of_robot = slice(i * n, i * n + n)
        m, B = mean[of_robot], rows[of_robot, 4:]
        cov, y = B @ B.T, unit.contact_rate[:, 0]
        seen = np.flatnonzero(~np.isnan(y))
        S = cov[np.ix_(seen, seen)] + 0.05**2 * np.eye(len(seen))
        for k, step in enumerate((n - 3, n - 2, n - 1)):
            gain = np.linalg.solve(S, cov[seen, step])
            center = m[step] + gain @ (y[seen] - m[seen])
            sd = np.sqrt(cov[step, step] - gain @ cov[seen, step] + 0.05**2)
            low, middle, high = found["quantile"].values[[0, 2, 4], 0, k, i]
            # Quantiles of 1000 draws: 4 standard errors.
            assert abs(middle - center) < 4.0 * 1.2533 * sd / np.sqrt(1000)
            assert abs((high - low) / (2 * 1.645 * sd) - 1.0) < 0.2


def test_levels_have_probabilities_and_robots_without_reports_too(missions):
    told = []
    for mission in missions:
        answers = np.round(1 + 6 * mission.reports.values)
        answers[:, 1] = np.nan
        told.append(mission.with_reports(answers, person="ann", scale="likert7"))
    tree = fit_reports(told)
    rates = np.random.default_rng(0).uniform(0.0, 1.0, (50, 4, 2))
    found = expect_reports(tree, told, rates)
    assert found["probability"].sizes == {"answer": 7, "person": 1, "bound": 5, "robot": 2}
    np.testing.assert_allclose(found["probability"].sum("answer"), 1.0)
    assert np.isnan(found["last"].sel(robot="r2", person="ann"))
    assert found["last"].sel(robot="r1", person="ann") == told[-1].reports.answers[-1, 0]
    mean = found["probability"].dot(found["answer"])  # answers are 1 to 7
    np.testing.assert_allclose(found["mean"], mean.transpose(*found["mean"].dims), atol=1e-6)
    wide = found["quantile"].isel(level=-1) - found["quantile"].isel(level=0)
    assert (wide.sel(robot="r2") > wide.sel(robot="r1")).all()  # of which nothing is known
    same = expect_reports(tree, told, rates)
    assert same.identical(found)


def test_contact_of_another_shape_is_refused(posterior, missions):
    with pytest.raises(ShapeError, match=r"contact must be \(bound, 2\), or .*got \(4, 3\)"):
        expect_reports(posterior, missions, np.zeros((4, 3)))
    with pytest.raises(TrustboError, match=r"contact: \[0, 0, 0\] = 2 is outside \[0, 1\]"):
        expect_reports(posterior, missions, np.full((4, 2), 2.0))
    other = fit(missions, progress=False, whole=False)
    with pytest.raises(TrustboError, match="expect_reports takes a posterior of fit_reports"):
        expect_reports(other, missions, np.zeros((4, 2)))
    with pytest.raises(TrustboError, match="no mission has reports of trust"):
        fit_reports([tb.Mission.from_arrays([(0, 0), (0, 1)], [[[0.5]]], [[0.5]])])
