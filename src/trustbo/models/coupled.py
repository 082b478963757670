"""The paper's coupled trust model, equations (1)-(2)."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpyro.distributions as dist
from numpyro.distributions import Distribution

from trustbo.models.backend import namespace
from trustbo.models.effects.effect import Theta
from trustbo.models.effects.weights import CoupledWeights
from trustbo.models.model import TrustModel
from trustbo.models.params import CoupledParams
from trustbo.models.signal import Layout, Signal
from trustbo.models.slots import Slots


@dataclass(frozen=True, repr=False)
class CoupledTrust(TrustModel):
    """Model in which robots influence each other and have separate parameters, equations (1)-(2).

    x_k = B0 x_{k-1} + sum_m B_m z_{k,m} + b + w_k,  y_k = x_k + v_k,  w ~ N(0, Delta_w),
    v ~ N(0, Delta_v)

    `Priors.coupling` is the prior on the off-diagonal entries of B0 and B_m. The covariances are
    diag(sd) R diag(sd), with an LKJ prior on the correlations R.
    """

    @property
    def weights(self) -> CoupledWeights:
        """See `TrustModel.weights`."""
        return CoupledWeights(self.priors)

    def hyperpriors(self, n_robots: int, n_features: int) -> dict[str, Distribution]:
        """See `TrustModel.hyperpriors`; the correlations R are given by partial correlations."""
        n, priors = n_robots, self.priors
        names = ("beta0", "delta_w", "delta_v")
        named = {name: getattr(priors, name).expand((n,)) for name in names}
        if n == 1:
            return named
        named["coupling"] = priors.coupling.expand((n * (n - 1),))
        column = np.tril_indices(n, -1)[1]
        shape = priors.concentration + 0.5 * (n - 2 - column)
        partials = {"partial_w": dist.Beta(shape, shape)}
        if self.family.adds_noise:
            partials["partial_v"] = dist.Beta(shape, shape)
        return named | partials

    def derived(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """See `TrustModel.derived`; adds the matrices B0, Delta_w and Delta_v."""
        if "B0" in values:
            B0 = values["B0"]
            return {**values, "rest": 1.0 - namespace(B0).diagonal(B0, axis1=1, axis2=2)}
        beta0, xp = values["beta0"], namespace(values["beta0"])
        n = beta0.shape[1]
        B0 = beta0[:, :, None] * np.eye(n)
        if n > 1:
            place = np.eye(n * n)[~np.eye(n, dtype=bool).ravel()]  # position of each coupling
            B0 = B0 + (values["coupling"] @ place).reshape(-1, n, n)
        derived: dict[str, Any] = {"B0": B0, "rest": 1.0 - beta0}
        for noise in ("w", "v"):
            factor = xp.broadcast_to(np.eye(n), B0.shape)
            if f"partial_{noise}" in values:
                factor = correlation_factor(2.0 * values[f"partial_{noise}"] - 1.0, n)
            factor = values[f"delta_{noise}"][:, :, None] * factor
            derived[f"Delta_{noise}"] = factor @ xp.swapaxes(factor, 1, 2)
        return {**derived, **values}

    def layout(self, slots: Slots, *, contrasts: bool = True) -> Layout:
        """See `TrustModel.layout`; each block is a mission."""
        return Layout(slots.y.shape, joint=True)

    def signal(self, theta: Theta, slots: Slots, layout: Layout) -> Signal:
        """Compute the trust of all robots at all bounds, with rows ordered as (bound, robot).

        The observation noise has a shared part (Delta_v - eps I) and an independent part (eps I).
        """
        B0, K, R = theta["B0"], slots.n_bounds, slots.n_robots
        xp: Any = namespace(B0)
        T = xp.linalg.inv(np.eye(K * R) - _kron(np.eye(K, k=-1), B0))  # (1 - Lag x B0)^-1
        start = T[:, :, :R] @ B0
        S = T @ _kron(np.eye(K), theta["Delta_w"]) @ xp.swapaxes(T, 1, 2)
        S = S + self.x0["x0_sd"] ** 2 * start @ xp.swapaxes(start, 1, 2)
        m, noise = (self.x0["x0_mean"] * start.sum(2))[:, None], theta["Delta_v"]
        if not self.family.adds_noise:
            sd = xp.sqrt(xp.diagonal(noise, axis1=1, axis2=2))
            return Signal(m, T[:, None], S[:, None], xp.tile(sd[:, None], (1, 1, K)))
        eps = 0.5 * xp.linalg.eigvalsh(noise)[:, 0]
        noise = _kron(np.eye(K), noise - eps[:, None, None] * np.eye(R))
        return Signal(m, T[:, None], S[:, None], xp.sqrt(eps)[:, None, None], noise[:, None])

    def prior_terms(self, sites: Mapping[str, np.ndarray]) -> dict[str, tuple[str, np.ndarray]]:
        """See `TrustModel.prior_terms`; diagonal and off-diagonal entries are separate terms."""
        off = ~np.eye(sites["b"].shape[-1], dtype=bool)
        diagonal = {
            name: np.einsum("...ii->...i", sites[name]) for name in self.dims if name != "b"
        }
        return {
            "B0": ("beta0", diagonal["B0"]),
            "B0_coupling": ("coupling", sites["B0"][..., off]),
            "B": ("beta", np.swapaxes(diagonal["B"], -1, -2)),
            "B_coupling": ("coupling", sites["B"][..., off]),
            "b": ("b", sites["b"]),
            "delta_w": ("delta_w", np.sqrt(diagonal["Delta_w"])),
            "delta_v": ("delta_v", np.sqrt(diagonal["Delta_v"])),
        }

    @property
    def dims(self) -> dict[str, tuple[str, ...]]:
        """See `TrustModel.dims`."""
        return {name: CoupledParams.AXES[name] for name in CoupledParams._fields[:5]}


def correlation_factor(r: Any, n: int) -> Any:
    """Compute Cholesky factors (point, n, n) of correlation matrices from partial correlations."""
    xp, k, rows = namespace(r), 0, []
    for i in range(n):
        left, row = xp.ones(len(r)), []
        for _ in range(i):
            row.append(r[:, k] * left)
            left = left * xp.sqrt(1.0 - r[:, k] ** 2)
            k += 1
        zeros = [xp.zeros(len(r))] * (n - 1 - i)
        rows.append(xp.stack([*row, left, *zeros], axis=1))
    return xp.stack(rows, axis=1)


def _kron(A: np.ndarray, Q: Any) -> Any:
    """Compute the Kronecker product of a matrix (k, k) with each of the matrices (point, n, n)."""
    blocks = A[None, :, None, :, None] * Q[:, None, :, None, :]
    return blocks.reshape(len(Q), *(len(A) * Q.shape[1],) * 2)
