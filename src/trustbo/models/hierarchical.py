"""Separate coefficients for each robot, drawn from a common distribution."""

from collections.abc import Mapping
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from numpyro.distributions.transforms import biject_to

from trustbo.models.model import TrustModel, register, sample
from trustbo.models.params import RobotParams
from trustbo.models.priors_numpy import bijection, draw


@register
@dataclass(frozen=True, repr=False)
class HierarchicalTrust(TrustModel):
    """Coefficients per robot, partially pooled: between `PooledTrust` and separate robots.

    beta_{i,m} ~ N(mean_beta_m, tau_beta_m^2), b_i ~ N(mean_b, tau_b^2), and the same for beta0 on
    the real line, where its prior's support is mapped to (by the logit, if that is (0, 1)). The
    means have the priors of the pooled coefficients, the spreads `Priors.tau`; noises are shared.
    Its numpyro model is non-centred.
    """

    def sample_params(self, n_robots: int, n_features: int) -> RobotParams:
        """Sample statements of means, spreads, and each robot's deviation."""
        priors, unit, noises = self.priors, dist.Normal(0.0, 1.0), ("delta_w", "delta_v")
        size = {"beta0": (), "beta": (n_features,), "b": ()}
        mean = {"beta0": sample("mean_beta0", priors.beta0)}
        mean["beta"] = sample("mean_beta", priors.weights(mean["beta0"]), (n_features,))
        mean["b"] = sample("mean_b", priors.intercept(mean["beta0"]))
        tau = {name: sample(f"tau_{name}", priors.tau, shape) for name, shape in size.items()}
        e = {name: sample(f"e_{name}", unit, (n_robots, *size[name])) for name in size}
        noise = {name: sample(name, getattr(priors, name)) for name in noises}
        line = biject_to(priors.beta0.support)
        centre = mean | {"beta0": line.inv(mean["beta0"])}
        own = {name: centre[name] + tau[name] * e[name] for name in size}
        own["beta0"] = line(own["beta0"])
        for name, value in own.items():
            numpyro.deterministic(name, value)
        noise = {name: jnp.broadcast_to(sd, (n_robots,)) for name, sd in noise.items()}
        return RobotParams(**own, **noise, x0_mean=priors.x0_mean, x0_sd=priors.x0_sd)

    def draw_prior(
        self, shape: tuple[int, int], n: int, rng: np.random.Generator
    ) -> dict[str, np.ndarray]:
        """See `TrustModel.draw_prior`."""
        (n_robots, n_features), priors = shape, self.priors
        size = {"beta0": (), "beta": (n_features,), "b": ()}
        mean = priors.of_stationary(
            {name: draw(getattr(priors, name), (n, *size[name]), rng) for name in size}
        )
        tau = {name: draw(priors.tau, (n, *size[name]), rng) for name in size}
        from_line, to_line = bijection(priors.beta0.support)
        centre = mean | {"beta0": to_line(mean["beta0"])}
        draws = {
            name: centre[name][:, None]
            + tau[name][:, None] * rng.standard_normal((n, n_robots, *size[name]))
            for name in size
        }
        return {
            **draws,
            "beta0": from_line(draws["beta0"]),
            "delta_w": draw(priors.delta_w, (n,), rng),
            "delta_v": draw(priors.delta_v, (n,), rng),
            **{f"mean_{name}": mean[name] for name in size},
            **{f"tau_{name}": tau[name] for name in size},
        }

    def prior_terms(self, sites: Mapping[str, np.ndarray]) -> dict[str, tuple[str, np.ndarray]]:
        """See `TrustModel.prior_terms`: means, spreads and noises."""
        coefficients = ("beta0", "beta", "b")
        return (
            {f"mean_{name}": (name, sites[f"mean_{name}"]) for name in coefficients}
            | {f"tau_{name}": ("tau", sites[f"tau_{name}"]) for name in coefficients}
            | {name: (name, sites[name]) for name in ("delta_w", "delta_v")}
        )

    @property
    def robot_sets(self) -> str:
        """See `TrustModel.robot_sets`."""
        return "pooled"

    @property
    def dims(self) -> dict[str, tuple[str, ...]]:
        """Axes of each robot's coefficients, their means and spreads, and the noises."""
        return {
            "beta0": ("robot",),
            "beta": ("robot", "feature"),
            "b": ("robot",),
            "delta_w": (),
            "delta_v": (),
            "mean_beta0": (),
            "mean_beta": ("feature",),
            "mean_b": (),
            "tau_beta0": (),
            "tau_beta": ("feature",),
            "tau_b": (),
            **self.place_dims,
        }
