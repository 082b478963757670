"""The reference of every evidence: the joint normal of all rates and coefficients, written out.

The inputs of trust are U c, where the coefficients c (weights, effects of places, of robots and of
persons) are normal given the hyperparameters. U and the prior on c are formed here column by column
from the definitions of the models. Nothing of the package is imported; of a model, only its options
and the numbers of its priors are read. The cost grows with the cube of the number of rates.
"""

from typing import NamedTuple

import numpy as np
from dense_statespace import (
    Form,
    conditional,
    expected_trust,
    form_of,
    log_density,
    rate_noise,
    stacked,
    trust_covariance,
)
from scipy.linalg import block_diag, helmert

NUGGET = 1e-8
"""Variance added to the correlation of places, as the definition of `PlaceEffect` has it."""


class DenseRates:
    """Joint normal of all rates and coefficients at each theta.

    Attributes:
        y: Rates (rate,), flat over (mission, bound, robot); NaN where not measured.
        prior_mean, prior_cov: Moments of the coefficients, (point, column[, column]).
        of_c: Response (point, rate, column) of trust to the coefficients.
        start: Expected trust (point, rate) if all coefficients are 0.
        trust_cov, noise: Covariances (point, rate, rate) of trust and of the noise of rates, given
            the coefficients.
    """

    def __init__(self, model, observations, theta, bounds=None):
        """Form the joint normal.

        Args:
            model: Model whose options and priors are read.
            observations: Rates, awareness and names of features, which are read.
            theta: Hyperparameters (point, ...) by name.
            bounds: Moves, rows and columns (mission, bound, 3), -1 where there is none; needed with
                effects of places.
        """
        rates = observations.contact_rate
        n_missions, n_bounds, n_robots = rates.shape
        n_points = len(theta["delta_w"])
        points = [{name: v[i] for name, v in theta.items()} for i in range(n_points)]
        self.y = rates.ravel()

        drift, offset = inputs_of(model, observations, bounds)
        priors = [prior_of(model, observations, point, bounds) for point in points]
        self.prior_mean = np.stack([mean for mean, _ in priors])
        self.prior_cov = np.stack([cov for _, cov in priors])

        form = stacked([form_at(model, point, n_robots) for point in points])
        one = Form(*(value[:, None] for value in form))  # with an axis for columns
        zero = one._replace(m0=np.zeros_like(one.m0))
        nothing = np.zeros((1, n_bounds, n_robots))
        n = rates[0].size
        start = expected_trust(one, nothing, nothing).reshape(n_points, n)
        cov = trust_covariance(form, n_bounds)
        noise = rate_noise(form, n_bounds)

        self.start = np.tile(start, (1, n_missions))
        self.of_c = np.zeros((n_points, n_missions * n, len(drift)))
        self.trust_cov = np.zeros((n_points, n_missions * n, n_missions * n))
        self.noise = np.zeros_like(self.trust_cov)
        for j in range(n_missions):
            rows = slice(j * n, (j + 1) * n)
            response = expected_trust(zero, drift[:, j], offset[:, j])
            self.of_c[:, rows] = response.reshape(n_points, -1, n).mT
            self.trust_cov[:, rows, rows] = cov
            self.noise[:, rows, rows] = noise
            if "f_v" in theta:
                of_team = line_of_sight(observations)[j].mean(-1)
                g = scale_of(np.repeat(of_team, n_robots), theta["f_v"][:, None])
                self.noise[:, rows, rows] *= g[:, :, None] * g[:, None]

    @property
    def mean(self):
        """Mean (point, rate) of trust and rates, with the coefficients integrated out."""
        return self.start + (self.of_c @ self.prior_mean[..., None])[..., 0]

    @property
    def cov(self):
        """Covariance (point, rate, rate) of trust, with the coefficients integrated out."""
        return self.trust_cov + self.of_c @ self.prior_cov @ self.of_c.mT

    def log_density(self):
        """Log density (point,) of the rates, in nats."""
        return log_density(self.mean, self.cov + self.noise, self.y)

    def log_density_given(self, c):
        """Log density (point,) of the rates given coefficients c (point, column)."""
        mean = self.start + (self.of_c @ c[..., None])[..., 0]
        return log_density(mean, self.trust_cov + self.noise, self.y)

    def coefficients(self):
        """Mean and covariance (point, column[, column]) of the coefficients given the rates."""
        cross = self.prior_cov @ self.of_c.mT
        prior = self.prior_mean, self.prior_cov
        return conditional(*prior, cross, self.mean, self.cov + self.noise, self.y)

    def new_rates(self):
        """Mean and covariance of rates with other noise, given those that are measured."""
        rates = self.mean, self.cov + self.noise
        return conditional(*rates, self.cov, *rates, self.y)


def form_at(model, theta, n_robots):
    """Form of a model at one theta."""
    x0 = float(model.priors.x0_mean), float(model.priors.x0_sd)
    if "B0" in theta:
        noises = theta["Delta_w"], theta["Delta_v"]
        return form_of(theta["B0"], *noises, *x0, n_robots=n_robots)
    return form_of(
        theta["beta0"], theta["delta_w"], theta["delta_v"], *x0, n_robots=n_robots,
        delta_s=theta.get("delta_s", 0.0), deviation=model.memory == "deviation",
    )  # fmt: skip


def inputs_of(model, observations, bounds=None):
    """Drift and offset (column, mission, bound, robot) of each coefficient."""
    lasts = model.memory != "deviation"
    columns = []
    for part in (model, *model.effects):
        of_part = INPUTS[type(part).__name__](observations, bounds)
        columns += [one if isinstance(one, tuple) else (one, lasts) for one in of_part]

    shape = observations.contact_rate.shape
    values = np.stack([values * np.ones(shape) for values, _ in columns])
    carried = np.array([carried for _, carried in columns])[:, None, None, None]
    return np.where(carried, values, 0.0), np.where(carried, 0.0, values)


def features_of(observations):
    """Awareness (mission, bound, robot, feature + 1), of which the last is 1 for the intercept."""
    z = observations.awareness
    return np.concatenate([z, np.ones((*z.shape[:3], 1))], axis=3)


def of_each(n):
    """Masks (n,) of each of n robots."""
    return np.eye(n, dtype=bool)


def of_missions(n):
    """Masks (mission, 1, 1) of each of n missions."""
    return np.eye(n, dtype=bool)[:, :, None, None]


def pooled_inputs(observations, bounds):
    """A weight of each feature and an intercept, common to all robots."""
    return list(np.moveaxis(features_of(observations), 3, 0))


def hierarchical_inputs(observations, bounds):
    """Weights and intercepts of each robot; the robot varies fastest."""
    every = np.moveaxis(features_of(observations), 3, 0)
    return [values * robot for values in every for robot in of_each(every.shape[-1])]


def coupled_inputs(observations, bounds):
    """For each robot the weights of the features of all robots, and an intercept."""
    z = observations.awareness
    columns = []
    for robot in of_each(z.shape[2]):
        for j in range(z.shape[2]):
            columns += [z[:, :, j, m, None] * robot for m in range(z.shape[3])]
        columns.append(robot)
    return columns


def human_inputs(observations, bounds):
    """Weights, of which those of outcomes last, and the parts of each person (a mission)."""
    z, names = observations.awareness, observations.features
    outcomes = [
        [m for m, name in enumerate(names) if name.startswith(prefix)]
        for prefix in ("success", "failure")
    ]
    columns = [(z[..., m], any(m in named for named in outcomes)) for m in range(z.shape[3])]
    columns.append((1.0, False))

    first = (np.arange(z.shape[1]) == 0)[:, None]
    for person in of_missions(len(z)):
        columns += [(person * first, True), (person, False)]  # start and level
        columns += [(person * z[..., named[0]], True) for named in outcomes]  # gains
    return columns


def place_inputs(observations, bounds):
    """Effects of the cells entered, of the directed bounds, and of each robot in a bound."""
    columns = [(bounds[..., 1:] == cell).all(-1)[..., None] for cell in cells_of(bounds)]
    columns += [(bounds == bound).all(-1)[..., None] for bound in bounds_of(bounds)]
    contrasts = helmert(observations.contact_rate.shape[2])
    return columns + [
        (bounds == bound).all(-1)[..., None] * contrast
        for bound in bounds_of(bounds)
        for contrast in contrasts
    ]


def robot_inputs(observations, bounds):
    """Effects of each robot in each mission, per line of sight; the mission varies fastest."""
    n_missions, _, n_robots = observations.contact_rate.shape
    sight = line_of_sight(observations)
    return [
        sight * mission * robot
        for robot in of_each(n_robots)
        for mission in of_missions(n_missions)
    ]


INPUTS = {
    "PooledTrust": pooled_inputs,
    "HierarchicalTrust": hierarchical_inputs,
    "CoupledTrust": coupled_inputs,
    "HumanTrust": human_inputs,
    "PlaceEffect": place_inputs,
    "RobotEffect": robot_inputs,
}
"""Inputs of trust per unit of each coefficient, by the class that brings the coefficients.

An input may be a pair with whether it is carried over to later bounds.
"""


class Gain(NamedTuple):
    """What a coefficient of stationary trust adds to the drift."""

    of_effects: np.ndarray  # (robot,)
    of_weights: np.ndarray  # (robot,), 1 unless priors are on stationary trust


def prior_of(model, observations, theta, bounds=None):
    """Mean (column,) and covariance (column, column) of the coefficients at one theta."""
    n_robots = observations.contact_rate.shape[2]
    one = np.ones(n_robots)
    gain = one
    if model.memory != "deviation":
        gain = one - (np.diag(theta["B0"]) if "B0" in theta else theta["beta0"])
    gain = Gain(gain, gain if model.priors.stationary else one)

    groups = []
    for part in (model, *model.effects):
        groups += PRIORS[type(part).__name__](part, observations, theta, bounds, gain)
    return np.concatenate([mean for mean, _ in groups]), block_diag(*(cov for _, cov in groups))


def weight_prior(model, n_features):
    """Prior means and standard deviations (feature + 1,) of the weights and the intercept."""
    beta, b = model.priors.beta, model.priors.b
    mean = np.append(np.broadcast_to(beta.loc, n_features), b.loc)
    return mean, np.append(np.broadcast_to(beta.scale, n_features), b.scale)


def pooled_prior(model, observations, theta, bounds, gain):
    """Independent normal priors."""
    mean, sd = weight_prior(model, observations.awareness.shape[3])
    return [(gain.of_weights[0] * mean, np.diag(gain.of_weights[0] * sd) ** 2)]


def hierarchical_prior(model, observations, theta, bounds, gain):
    """Coefficients of robots, with a normal common mean integrated out."""
    n_robots, n_features = observations.awareness.shape[2:]
    mean, sd = weight_prior(model, n_features)
    tau = np.append(theta["tau_beta"], theta["tau_b"])
    scale = gain.of_weights
    return [
        (scale * mean[m], (scale[0] * sd[m]) ** 2 + tau[m] ** 2 * np.eye(n_robots))
        for m in range(n_features + 1)
    ]


def coupled_prior(model, observations, theta, bounds, gain):
    """Own weights as of the pooled model, and weights of other robots' features."""
    n_robots, n_features = observations.awareness.shape[2:]
    mean, sd = weight_prior(model, n_features)
    coupling = model.priors.coupling
    means = np.full((n_robots, n_robots, n_features), float(coupling.loc))
    sds = np.full((n_robots, n_robots, n_features), float(coupling.scale))
    groups = []
    for i, scale in enumerate(gain.of_weights):
        means[i, i], sds[i, i] = scale * mean[:-1], scale * sd[:-1]
        of_robot = np.append(means[i], scale * mean[-1]), np.append(sds[i], scale * sd[-1])
        groups.append((of_robot[0], np.diag(of_robot[1]) ** 2))
    return groups


def human_prior(model, observations, theta, bounds, gain):
    """Weights as of the pooled model, and parts of persons with mean 0."""
    sds = [theta[name] for name in ("tau_start", "tau_level", "tau_gain", "tau_gain")]
    persons = [(np.zeros(4), np.diag(sds) ** 2)] * len(observations.contact_rate)
    return pooled_prior(model, observations, theta, bounds, gain) + persons


def place_prior(effect, observations, theta, bounds, gain):
    """A Matern 3/2 process over cells, effects of bounds, and of robots, which sum to 0."""
    cells, places = cells_of(bounds), bounds_of(bounds)
    n_contrasts = observations.contact_rate.shape[2] - 1
    sight = line_of_sight(observations)
    of_bounds = [sight[(bounds == bound).all(-1)].mean() for bound in places]
    floor = floor_of(effect, observations)
    g = scale_of(np.array(of_bounds), floor)
    of_robots = scale_of(np.array(of_bounds), max(floor, 0.1))
    distance = np.linalg.norm(cells[:, None] - cells, axis=2)
    h = np.sqrt(3.0) * distance / theta["length_scale"]
    matern = (1.0 + h) * np.exp(-h) + NUGGET * np.eye(len(cells))
    return [
        (np.zeros(len(cells)), theta["tau_s"] ** 2 * matern),
        (np.zeros(len(g)), theta["tau_e"] ** 2 * np.outer(g, g) * between_posts(places)),
        (
            np.zeros(len(g) * n_contrasts),
            theta["tau_r"] ** 2 * np.diag(np.repeat(of_robots**2, n_contrasts)),
        ),
    ]


def floor_of(effect, observations):
    """Floor of the scale of effects of bounds; without line of sight, the scale is 1."""
    named = any(name.startswith("line_of_sight") for name in observations.features)
    return effect.f_e if named else 1.0


def robot_prior(effect, observations, theta, bounds, gain):
    """A lasting, a slow and a part of one mission, independent between robots."""
    mission = np.arange(len(observations.contact_rate))
    slow = effect.rho ** np.abs(mission[:, None] - mission)
    cov = theta["tau_slow"] ** 2 * slow + theta["tau_mission"] ** 2 * np.eye(len(mission))
    cov = cov + theta.get("tau_lasting", 0.0) ** 2
    return [(np.zeros(len(mission)), of_robot**2 * cov) for of_robot in gain.of_effects]


PRIORS = {
    "PooledTrust": pooled_prior,
    "HierarchicalTrust": hierarchical_prior,
    "CoupledTrust": coupled_prior,
    "HumanTrust": human_prior,
    "PlaceEffect": place_prior,
    "RobotEffect": robot_prior,
}
"""Means and covariances of groups of coefficients, in the order of `INPUTS`."""


def scale_of(sight, floor):
    """Scale of effects and noise, by line of sight m: its square is 4 m (1 - m) from the floor."""
    return np.sqrt(4.0 * sight * (1.0 - sight) * (1.0 - floor**2) + floor**2)


def between_posts(bounds):
    """Correlation of the effects of bounds: 0.5 between the sets of posts of the same bound."""
    plain = bounds % (8, 1_000_000, 1_000_000)
    same = (plain[:, None] == plain).all(-1)
    return np.where(same, 0.5, 0.0) + 0.5 * np.eye(len(bounds))


def cells_of(bounds):
    """Cells entered (cell, 2), sorted."""
    return np.array(sorted({tuple(b[1:]) for b in bounds.reshape(-1, 3).tolist() if b[0] >= 0}))


def bounds_of(bounds):
    """Directed bounds (bound, 3), sorted."""
    return np.array(sorted({tuple(b) for b in bounds.reshape(-1, 3).tolist() if b[0] >= 0}))


def line_of_sight(observations):
    """Mean (mission, bound, robot) of the features of line of sight; 1 without any."""
    named = [m for m, n in enumerate(observations.features) if n.startswith("line_of_sight")]
    if not named:
        return np.ones(observations.awareness.shape[:3])
    return observations.awareness[..., named].mean(-1)
