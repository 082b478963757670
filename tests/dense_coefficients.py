"""The reference of every evidence: the joint normal of all rates and coefficients, written out.

The inputs of trust are U c, where the coefficients c (weights, effects of places, of robots and of
persons) are normal given the hyperparameters. U and the prior on c are formed here column by column
from the definitions of the models. Nothing of the package is imported; of a model, only its options
and the numbers of its priors are read. The cost grows with the cube of the number of rates.
"""

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
    kind = type(model).__name__
    z = observations.awareness
    n_missions, n_bounds, n_robots, n_features = z.shape
    every = np.concatenate([z, np.ones((*z.shape[:3], 1))], axis=3)  # the intercept is last
    columns, carried = [], []

    def add(values, lasts=None):
        columns.append(values * np.ones(z.shape[:3]))
        carried.append(model.memory != "deviation" if lasts is None else lasts)

    def of_robot(i):
        return np.arange(n_robots) == i

    if kind == "CoupledTrust":
        for i in range(n_robots):
            for j in range(n_robots):
                for m in range(n_features):
                    add(z[:, :, j, m, None] * of_robot(i))
            add(of_robot(i))
    elif kind == "HierarchicalTrust":
        for m in range(n_features + 1):
            for i in range(n_robots):
                add(every[..., m] * of_robot(i))
    elif kind == "HumanTrust":
        outcomes = {
            prefix: [m for m, name in enumerate(observations.features) if name.startswith(prefix)]
            for prefix in ("success", "failure")
        }
        for m in range(n_features):
            add(z[..., m], m in sum(outcomes.values(), []))
        add(1.0, False)
        for j in range(n_missions):  # a person is a mission
            person = (np.arange(n_missions) == j)[:, None, None]
            first = (np.arange(n_bounds) == 0)[:, None]
            add(person * first, True)  # start
            add(person, False)  # level
            for named in outcomes.values():
                add(person * z[..., named[0]] if named else 0.0 * person, True)  # gain
    else:
        for m in range(n_features + 1):
            add(every[..., m])

    for effect in model.effects:
        if type(effect).__name__ == "PlaceEffect":
            for cell in cells_of(bounds):
                add((bounds[..., 1:] == cell).all(-1)[..., None])
            for bound in bounds_of(bounds):
                add((bounds == bound).all(-1)[..., None])
        else:
            sight = line_of_sight(observations)
            for i in range(n_robots):
                for j in range(n_missions):
                    mission = (np.arange(n_missions) == j)[:, None, None]
                    add(sight * mission * of_robot(i))

    columns = np.stack(columns).astype(float)
    lasts = np.array(carried)[:, None, None, None]
    return np.where(lasts, columns, 0.0), np.where(lasts, 0.0, columns)


def prior_of(model, observations, theta, bounds=None):
    """Mean (column,) and covariance (column, column) of the coefficients at one theta."""
    kind, priors = type(model).__name__, model.priors
    n_missions, _, n_robots, n_features = observations.awareness.shape
    mean = np.append(np.broadcast_to(priors.beta.loc, n_features), priors.b.loc)
    sd = np.append(np.broadcast_to(priors.beta.scale, n_features), priors.b.scale)

    # Priors may be on what a coefficient adds to stationary trust.
    gain = np.ones(n_robots)
    if model.memory != "deviation":
        gain = (1.0 - (np.diag(theta["B0"]) if "B0" in theta else theta["beta0"])) * gain
    scale = gain if priors.stationary else np.ones(n_robots)

    means, covs = [], []
    if kind == "CoupledTrust":
        for i in range(n_robots):
            for j in range(n_robots):
                if i == j:
                    means.append(scale[i] * mean[:-1])
                    covs.append(np.diag(scale[i] * sd[:-1]) ** 2)
                else:
                    means.append(np.full(n_features, float(priors.coupling.loc)))
                    covs.append(np.eye(n_features) * float(priors.coupling.scale) ** 2)
            means.append(scale[i] * mean[-1:])
            covs.append(np.array([[scale[i] * sd[-1]]]) ** 2)
    elif kind == "HierarchicalTrust":
        tau = np.append(theta["tau_beta"], theta["tau_b"])
        for m in range(n_features + 1):
            means.append(np.full(n_robots, scale[0] * mean[m]))
            covs.append((scale[0] * sd[m]) ** 2 + tau[m] ** 2 * np.eye(n_robots))
    else:
        means.append(scale[0] * mean)
        covs.append(np.diag(scale[0] * sd) ** 2)
    if kind == "HumanTrust":
        for _ in range(n_missions):
            sds = [theta[name] for name in ("tau_start", "tau_level", "tau_gain", "tau_gain")]
            means.append(np.zeros(4))
            covs.append(np.diag(sds) ** 2)

    for effect in model.effects:
        if type(effect).__name__ == "PlaceEffect":
            cells = cells_of(bounds)
            gap = np.linalg.norm(cells[:, None] - cells, axis=2) * np.sqrt(3.0)
            h = gap / theta["length_scale"]
            matern = (1.0 + h) * np.exp(-h) + NUGGET * np.eye(len(cells))
            covs.append(theta["tau_s"] ** 2 * matern)
            covs.append(theta["tau_e"] ** 2 * np.eye(len(bounds_of(bounds))))
        else:
            mission = np.arange(n_missions)
            lasting = effect.rho ** np.abs(mission[:, None] - mission)
            of_one = theta["tau_slow"] ** 2 * lasting + theta["tau_mission"] ** 2 * np.eye(
                n_missions
            )
            covs += [gain[i] ** 2 * of_one for i in range(n_robots)]

    n_columns = sum(len(cov) for cov in covs)
    means = np.concatenate(means)
    every = np.zeros((n_columns, n_columns))
    first = 0
    for cov in covs:
        last = first + len(cov)
        every[first:last, first:last] = cov
        first = last
    return np.append(means, np.zeros(n_columns - len(means))), every


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
