"""Parameters of the state-space form, and constructors for the paper's equations."""

from collections.abc import Sequence
from typing import Any, NamedTuple, Self

import numpy as np

from trustbo.statespace.matrices import namespace, product, repeat_diagonal, transpose


class Inputs(NamedTuple):
    """Inputs of trust, with any leading axes and the last axis (robot,)."""

    drift: Any
    """Input u that is carried over to later bounds."""
    offset: Any = 0.0
    """Input o that affects the trust of one bound only."""
    noise: Any = 1.0
    """Factor g of the standard deviation of each rate's own noise."""


class StateSpace(NamedTuple):
    """Parameters of a linear Gaussian state-space model of trust.

        d_k = A d_{k-1} + u_k + w_k,    w_k ~ N(0, Q),    d_0 ~ N(m0, P0)
        x_k = d_k + o_k,    f_k = x_k + v_k,    v_k ~ N(0, R),    y_k ~ likelihood(f_k, g_k sd)

    Robots are divided into groups that are independent of each other. The members of a group
    influence each other or share noise. A model without such dependence has groups of one robot.
    The axis `group` has length 1 if all groups have equal parameters. The leading axis `point` runs
    over values of the hyperparameters, for example over draws.

    `u`, `o` and `g` are not fields, because they depend on data; see `Inputs`.
    """

    transition: Any
    """A, shape (point, group, member, member)."""
    process_cov: Any
    """Q, shape (point, group, member, member)."""
    initial_mean: Any
    """m0, shape (point, group, member)."""
    initial_cov: Any
    """P0, shape (point, group, member, member)."""
    noise_sd: Any
    """sd of each rate's own noise, shape (point, group, member); see `Family`."""
    shared_cov: Any = None
    """R, shape (point, group, member, member), or None if robots share no noise."""

    @property
    def n_members(self) -> int:
        """Number of robots in a group."""
        return self.transition.shape[-1]

    @property
    def rate_sd(self) -> Any:
        """Standard deviation (point, group, member) of own and shared noise together."""
        if self.shared_cov is None:
            return self.noise_sd

        xp = namespace(self.noise_sd)
        return xp.sqrt(self.noise_sd**2 + xp.diagonal(self.shared_cov, axis1=-2, axis2=-1))

    def with_noise(self, sd: Any) -> Self:
        """Return the form with more of each rate's own noise, of standard deviation sd."""
        return self._replace(noise_sd=namespace(self.noise_sd).hypot(self.noise_sd, sd))

    def take(self, index: Any) -> Self:
        """Select points by an index array, a mask or a slice."""
        fields = [None if value is None else value[index] for value in self]
        return type(self)(*fields)

    @property
    def is_uncoupled(self) -> bool:
        """Whether the trust in no robot depends on that in others; noise may be shared."""
        A = np.asarray(self.transition)
        n = self.n_members
        return n == 1 or (A.shape[1] == 1 and not A[..., ~np.eye(n, dtype=bool)].any())

    def of_robots(self, which: Sequence[int]) -> Self:
        """Return the form of some robots, by position, if `is_uncoupled`."""
        some = list(which)
        if self.n_members == 1:  # groups are robots, or there is one for all
            fields = [v if v is None or v.shape[1] == 1 else v[:, some] for v in self]
            return type(self)(*fields)

        vectors = ("initial_mean", "noise_sd")
        kept = {}
        for name, value in self._asdict().items():
            if value is not None:
                kept[name] = value[..., some]
                kept[name] = kept[name] if name in vectors else kept[name][..., some, :]
        return type(self)(**kept)

    def grouped(self, values: Any) -> Any:
        """Rearrange values (..., robot) as (..., group, member)."""
        n_robots = values.shape[-1]
        n = self.n_members
        return values.reshape(*values.shape[:-1], n_robots // n, n)

    def over_robots(self, n_robots: int) -> Any:
        """Return the transition matrix A of all robots, shape (point, robot, robot)."""
        A = self.transition
        if self.n_members > 1:
            return A[:, 0]

        diagonal = namespace(A).broadcast_to(A[..., 0], (len(A), n_robots, 1))
        return diagonal * np.eye(n_robots)

    def in_contrasts(self, rotation: np.ndarray) -> Self:
        """Return the form of orthonormal combinations (combination, robot) of exchangeable robots.

        A, Q and P0 must be multiples of the identity, and R a multiple of 11'. Combinations are
        independent, so each is a group. Only the first one, which is the scaled mean over the
        robots, has a nonzero mean and shared noise. The axis `group` is therefore (first, others).
        """
        sums = rotation[:2].sum(1)  # sqrt(n) and 0
        mean = self.initial_mean[..., :1] * sums[:, None]
        shared = self.shared_cov
        if shared is not None:
            shared = shared[..., :1, :1] * (sums**2)[:, None, None]

        return type(self)(
            transition=self.transition[..., :1, :1],
            process_cov=self.process_cov[..., :1, :1],
            initial_mean=mean,
            initial_cov=self.initial_cov[..., :1, :1],
            noise_sd=self.noise_sd[..., :1],
            shared_cov=shared,
        )

    def response(self, n_bounds: int) -> Any:
        """Compute the response T[k, j] = A^(k - j) of the state d_k to the drift u_j, for j <= k.

        The shape is (point, group, row, row), with rows (bound, member).
        """
        A = self.transition
        xp = namespace(A)
        n = self.n_members
        if n == 1:
            lag = np.subtract.outer(np.arange(n_bounds), np.arange(n_bounds))
            return xp.where(lag >= 0, A ** np.maximum(lag, 0), 0.0)

        shift = np.eye(n_bounds, k=-1)
        lagged = shift[:, None, :, None] * A[..., None, :, None, :]
        lagged = lagged.reshape(*A.shape[:2], n_bounds * n, n_bounds * n)
        return xp.linalg.inv(np.eye(n_bounds * n) - lagged)

    def moments(self, n_bounds: int) -> tuple[Any, Any, Any]:
        """Compute the distribution of the states of all bounds given the drift.

        Returns:
            The mean m (point, group, row) without drift, the response T of `response`, and the
            covariance S (point, group, row, row), so that d ~ N(m + T u, S).
        """
        T = self.response(n_bounds)
        of_start = product(T[..., : self.n_members], self.transition)  # A^k, for k = 1, 2, ...
        mean = (of_start * self.initial_mean[..., None, :]).sum(-1)
        S = _sandwich(T, self.process_cov, n_bounds)
        S = S + _sandwich(of_start, self.initial_cov, 1)
        return mean, T, S


def _sandwich(T: Any, Q: Any, n: int) -> Any:
    """Compute T kron(I_n, Q) T'."""
    if Q.shape[-1] == 1:
        return Q * (T @ transpose(T))

    return T @ repeat_diagonal(Q, n) @ transpose(T)


def independent_robots(
    beta0: Any,
    delta_w: Any,
    delta_v: Any,
    x0_mean: Any,
    x0_sd: Any,
    *,
    delta_s: Any = None,
    n_members: int = 1,
) -> StateSpace:
    """Return the form of equations (3)-(4), in which robots do not influence each other.

        x_k = beta0 x_{k-1} + u_k + delta_w w_k,    y_k = x_k + delta_v v_k + delta_s s_k

    Args:
        beta0: Autoregression coefficient, shape (point,) if common to all robots, or (point,
            robot).
        delta_w: Standard deviation of the process noise, shaped like `beta0`.
        delta_v: Standard deviation of the observation noise, shaped like `beta0`.
        x0_mean: Mean of the state before the first bound, shape (), (point,) or (point, robot).
        x0_sd: Standard deviation of the state before the first bound, of the same shapes.
        delta_s: Standard deviation of the noise s that all robots share, shape (point,), or None.
        n_members: 1 for groups of one robot, or the number of robots for a single group, which
            `delta_s` requires.
    """
    xp = namespace(beta0)
    n_points = len(beta0)
    identity = np.eye(n_members)

    def vector(values: Any) -> Any:
        """Give values the axes (point, group, member)."""
        if np.ndim(values) == 0:
            values = xp.full(n_points, values)
        values = values.reshape(n_points, -1)
        if n_members == 1:
            return values[:, :, None]
        return xp.broadcast_to(values[:, None, :], (n_points, 1, n_members))

    def diagonal(values: Any) -> Any:
        """Give values the axes (point, group, member, member)."""
        return vector(values)[..., None] * identity

    shared = None
    if delta_s is not None:
        shared = delta_s[:, None, None, None] ** 2 * np.ones((n_members, n_members))

    return StateSpace(
        transition=diagonal(beta0),
        process_cov=diagonal(delta_w) ** 2,
        initial_mean=vector(x0_mean),
        initial_cov=diagonal(x0_sd) ** 2,
        noise_sd=vector(delta_v),
        shared_cov=shared,
    )


def coupled_robots(
    B0: Any, Delta_w: Any, Delta_v: Any, x0_mean: Any, x0_sd: Any, *, adds_noise: bool = True
) -> StateSpace:
    """Return the form of equations (1)-(2), in which robots influence each other.

        x_k = B0 x_{k-1} + u_k + w_k,    y_k = x_k + v_k,    w ~ N(0, Delta_w), v ~ N(0, Delta_v)

    Half of the smallest eigenvalue of Delta_v is each rate's own noise variance; the rest of
    Delta_v is shared noise.

    Args:
        B0: Transition matrix, shape (point, robot, robot).
        Delta_w: Covariance of the process noise, shape (point, robot, robot).
        Delta_v: Covariance of the observation noise, shape (point, robot, robot).
        x0_mean: Mean of trust before the first bound, shape (), (point,) or (point, robot).
        x0_sd: Standard deviation of trust before the first bound, of the same shapes.
        adds_noise: Whether the observation family adds noise to the linear predictor. If not,
            Delta_v is diagonal and robots share no noise.
    """
    xp = namespace(B0)
    n_points, n = B0.shape[:2]
    ones = np.ones((n_points, 1, n))
    mean = _per_point(x0_mean) * ones
    sd = _per_point(x0_sd) * ones
    if adds_noise:
        own = 0.5 * xp.linalg.eigvalsh(Delta_v)[:, :1]
        shared = (Delta_v - own[:, :, None] * np.eye(n))[:, None]
        noise_sd = xp.broadcast_to(xp.sqrt(own)[:, None], ones.shape)
    else:
        shared = None
        noise_sd = xp.sqrt(xp.diagonal(Delta_v, axis1=1, axis2=2))[:, None]

    return StateSpace(
        transition=B0[:, None],
        process_cov=Delta_w[:, None],
        initial_mean=mean,
        initial_cov=sd[..., None] ** 2 * np.eye(n),
        noise_sd=noise_sd,
        shared_cov=shared,
    )


def _per_point(values: Any) -> Any:
    """Give a number or values (point,) or (point, robot) the axes (point, group, member)."""
    if np.ndim(values) == 0:
        return values
    return values.reshape(len(values), 1, -1)
