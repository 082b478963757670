"""The paper's coupled trust model, equations (1)-(2)."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpyro.distributions as dist
from numpyro.distributions import Distribution

from trustbo.models.draws import COUPLED_DIMS
from trustbo.models.effects.effect import Theta
from trustbo.models.effects.weights import CoupledWeights
from trustbo.models.model import TrustModel
from trustbo.statespace import StateSpace
from trustbo.statespace.form import coupled_robots
from trustbo.statespace.matrices import namespace


@dataclass(frozen=True, repr=False)
class CoupledTrust(TrustModel):
    """Model in which robots have separate parameters and influence each other, equations (1)-(2).

    The vectors x_k of trust and y_k of contact rates in bound k are ::

        x_k = B0 x_{k-1} + sum_m B_m z_{k,m} + b + w_k,    w_k ~ N(0, Delta_w)
        y_k = x_k + v_k,                                   v_k ~ N(0, Delta_v)

    `Priors.coupling` is the prior on the off-diagonal entries of B0 and B_m. The covariances are
    diag(sd) R diag(sd), with an LKJ prior on the correlations R.

    Example:
        >>> posterior = tb.fit(missions, tb.models.CoupledTrust())
        >>> posterior["posterior"]["B0"].mean(("chain", "draw"))
    """

    @property
    def weights(self) -> CoupledWeights:
        """See `TrustModel.weights`."""
        return CoupledWeights(self.priors)

    def hyperpriors(self, n_robots: int, n_features: int) -> dict[str, Distribution]:
        """See `TrustModel.hyperpriors`; partial correlations determine the correlations R."""
        n = n_robots
        priors = self.priors
        names = ("beta0", "delta_w", "delta_v")
        named = {name: getattr(priors, name).expand((n,)) for name in names}
        if n == 1:
            return named

        named["coupling"] = priors.coupling.expand((n * (n - 1),))

        # Partial correlations of the LKJ prior (Lewandowski, Kurowicka and Joe 2009).
        column = np.tril_indices(n, -1)[1]
        shape = priors.concentration + 0.5 * (n - 2 - column)
        partials = {"partial_w": dist.Beta(shape, shape)}
        if self.likelihood.adds_noise:
            partials["partial_v"] = dist.Beta(shape, shape)

        return named | partials

    def derived(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """See `TrustModel.derived`; adds the matrices B0, Delta_w and Delta_v."""
        if "B0" in values:
            B0 = values["B0"]
            return {**values, "inverse_gain": 1.0 - namespace(B0).diagonal(B0, axis1=1, axis2=2)}

        beta0 = values["beta0"]
        xp = namespace(beta0)
        n = beta0.shape[1]
        B0 = beta0[:, :, None] * np.eye(n)
        if n > 1:
            place = np.eye(n * n)[~np.eye(n, dtype=bool).ravel()]  # position of each coupling
            B0 = B0 + (values["coupling"] @ place).reshape(-1, n, n)

        derived: dict[str, Any] = {"B0": B0, "inverse_gain": 1.0 - beta0}
        for noise in ("w", "v"):
            factor = xp.broadcast_to(np.eye(n), B0.shape)
            if f"partial_{noise}" in values:
                factor = correlation_factor(2.0 * values[f"partial_{noise}"] - 1.0, n)
            factor = values[f"delta_{noise}"][:, :, None] * factor
            derived[f"Delta_{noise}"] = factor @ xp.swapaxes(factor, 1, 2)

        return {**derived, **values}

    @property
    def joint(self) -> bool:
        """See `TrustModel.joint`."""
        return True

    def state_space(self, theta: Theta, n_robots: int) -> StateSpace:
        """See `TrustModel.state_space`."""
        return coupled_robots(
            theta["B0"],
            theta["Delta_w"],
            theta["Delta_v"],
            **self.x0,
            adds_noise=self.likelihood.adds_noise,
        )

    def prior_terms(
        self, parameters: Mapping[str, np.ndarray]
    ) -> dict[str, tuple[str, np.ndarray]]:
        """See `TrustModel.prior_terms`; diagonal and off-diagonal entries are separate terms."""
        off = ~np.eye(parameters["b"].shape[-1], dtype=bool)
        diagonal = {
            name: np.einsum("...ii->...i", parameters[name]) for name in self.dims if name != "b"
        }
        return {
            "B0": ("beta0", diagonal["B0"]),
            "B0_coupling": ("coupling", parameters["B0"][..., off]),
            "B": ("beta", np.swapaxes(diagonal["B"], -1, -2)),
            "B_coupling": ("coupling", parameters["B"][..., off]),
            "b": ("b", parameters["b"]),
            "delta_w": ("delta_w", np.sqrt(diagonal["Delta_w"])),
            "delta_v": ("delta_v", np.sqrt(diagonal["Delta_v"])),
        }

    @property
    def dims(self) -> dict[str, tuple[str, ...]]:
        """See `TrustModel.dims`."""
        return dict(COUPLED_DIMS)


def correlation_factor(r: Any, n: int) -> Any:
    """Compute Cholesky factors (point, n, n) of correlation matrices from partial correlations."""
    xp = namespace(r)
    k = 0  # index of the partial correlation, in the order of the lower triangle
    rows = []
    for i in range(n):
        row = []
        length = xp.ones(len(r))  # length of the rest of the row; whole rows have length 1
        for _ in range(i):
            row.append(r[:, k] * length)
            length = length * xp.sqrt(1.0 - r[:, k] ** 2)
            k += 1

        zeros = [xp.zeros(len(r))] * (n - 1 - i)
        rows.append(xp.stack([*row, length, *zeros], axis=1))

    return xp.stack(rows, axis=1)
