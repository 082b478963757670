"""The joint normal distribution of trust at all bounds of a mission, in independent blocks."""

from typing import Any, NamedTuple, Self

import numpy as np
from scipy import sparse
from scipy.linalg import helmert

from trustbo.statespace.form import Inputs, StateSpace
from trustbo.statespace.matrices import namespace, repeat_diagonal, transpose


class Layout(NamedTuple):
    """Layout of observations (mission, bound, robot) in blocks and rows.

    A block is a robot in a mission, with one row per bound. If `joint`, a block is a mission, with
    rows (bound, robot). With a `rotation`, blocks are orthonormal combinations of robots.
    """

    shape: tuple[int, int, int]  # numbers of missions, bounds and robots
    joint: bool = False
    rotation: np.ndarray | None = None  # (combination, robot)
    carried: Any = True
    """Whether the inputs are carried over: True for all, False for none, or a mask (column,)."""
    apart: bool = False
    """Whether all blocks have different matrices."""
    by_robot: bool = False
    """Whether the matrices of each robot are its own; only if blocks are robots."""

    @classmethod
    def from_rates(
        cls,
        y: np.ndarray,
        *,
        joint: bool,
        exchangeable: bool = False,
        carried: Any = True,
        apart: bool = False,
        by_robot: bool = False,
    ) -> Self:
        """Choose the smallest independent blocks.

        Args:
            y: Contact rates (mission, bound, robot), NaN where not measured.
            joint: Whether robots depend on each other.
            exchangeable: Whether robots depend on each other only through equal, shared noise. If
                all robots are measured together, their Helmert contrasts are independent.
            carried: See `Layout.carried`.
            apart: See `Layout.apart`.
            by_robot: See `Layout.by_robot`.
        """
        n_missions, n_bounds, n_robots = y.shape
        shape = n_missions, n_bounds, n_robots
        if n_robots == 1 and not apart:
            joint = False

        seen = ~np.isnan(y)
        together = bool((seen.all(2) == seen.any(2)).all())
        if joint and exchangeable and together:
            rotation = helmert(n_robots, full=True)
            return cls(shape, rotation=rotation, carried=carried, apart=apart)

        return cls(shape, joint=joint, carried=carried, apart=apart, by_robot=by_robot)

    @classmethod
    def of_space(cls, space: StateSpace, y: np.ndarray) -> Self:
        """Choose the smallest blocks of rates (mission, bound, robot) of a state-space form."""
        n_groups = max(field.shape[1] for field in space if field is not None)
        return cls.from_rates(y, joint=space.n_members > 1, by_robot=n_groups > 1)

    @property
    def label(self) -> np.ndarray:
        """Label (block,) of each block; blocks with equal labels have equal matrices."""
        n_missions, _, n_robots = self.shape
        if self.joint:
            return np.arange(n_missions) * int(self.apart)

        others = np.arange(n_robots) * int(self.by_robot)
        if self.rotation is not None:
            others[1:] = 1
        return np.tile(others, n_missions)

    def rows(self, values: np.ndarray) -> np.ndarray:
        """Rearrange values (..., mission, bound, robot) as (..., block, row)."""
        if self.rotation is not None:
            values = values @ self.rotation.T
        if not self.joint:
            values = np.swapaxes(values, -1, -2)
        *leading, n, a, b = values.shape
        if self.joint:
            return values.reshape(*leading, n, a * b)
        return values.reshape(*leading, n * a, b)

    def unstack(self, values: np.ndarray) -> np.ndarray:
        """Rearrange values (..., block, row) as (..., mission, bound, robot)."""
        n_missions, n_bounds, n_robots = self.shape
        leading = values.shape[:-2]
        if self.joint:
            return values.reshape(*leading, n_missions, n_bounds, n_robots)

        values = values.reshape(*leading, n_missions, n_robots, n_bounds)
        values = np.swapaxes(values, -1, -2)
        return values if self.rotation is None else values @ self.rotation

    def design(self, U: Any) -> Any:
        """Rearrange a sparse design matrix (observation, column) to (block * input, column).

        If only some columns are carried over, the inputs of a block begin with those of these
        columns in all rows, followed by those of the other columns.
        """
        n_missions, n_bounds, n_robots = self.shape
        n_rows = n_bounds * n_robots
        U = sparse.csr_array(U)
        if self.rotation is not None:
            of_bounds = sparse.eye_array(n_missions * n_bounds)
            U = sparse.csr_array(sparse.kron(of_bounds, self.rotation)) @ U

        if not isinstance(self.carried, bool):
            p = U.shape[1]
            masks = self.carried.astype(float), (~self.carried).astype(float)
            parts = [U @ sparse.diags_array(mask) for mask in masks]
            parts = [part.tocoo().reshape((n_missions, n_rows * p)) for part in parts]
            return sparse.hstack(parts).tocoo().reshape((2 * n_missions * n_rows, p)).tocsr()

        if self.joint:
            return U

        order = np.arange(n_missions * n_rows).reshape(n_missions, n_bounds, n_robots)
        return U[order.swapaxes(1, 2).ravel()]


class LinearPredictor(NamedTuple):
    """Trust x = m + T u + e of each block at each point, with e ~ N(0, S) and inputs u = U c.

    Each row of a block is an observation. The second axis is the label of a block (see `Layout`),
    and has length 1 if all blocks have equal matrices.
    """

    mean: Any
    """m, shape (point, label, row)."""
    response: Any
    """T, shape (point, label, row, input)."""
    trust_cov: Any
    """S, shape (point, label, row, row)."""
    noise_sd: Any
    """Standard deviation of each rate's own noise, shape (point, 1 or block, 1 or row)."""
    shared_cov: Any = None
    """Covariance of shared noise, shape (point, label, row, row), or None."""

    @classmethod
    def from_space(
        cls, space: StateSpace, layout: Layout, random: Inputs | None = None, noise: Any = 1.0
    ) -> Self:
        """Compute the distribution of trust at all bounds from the state-space form.

        Args:
            space: Parameters at each point.
            layout: Layout of the blocks.
            random: Inputs (point, mission, row, effect) of random effects that differ between
                missions. The effects are independent and standard normal.
            noise: Factor (point, mission, bound, robot or 1) of each rate's own noise, or 1.
        """
        n_bounds = layout.shape[1]
        if layout.rotation is not None:
            space = space.in_contrasts(layout.rotation)

        mean, response, cov = space.moments(n_bounds)
        xp: Any = namespace(response)
        if random is not None:
            effects = response @ random.drift + random.offset
            cov = cov + effects @ transpose(effects)

        identity = xp.broadcast_to(np.eye(response.shape[-1]), response.shape)
        if layout.carried is True:
            inputs = response
        elif layout.carried is False:
            inputs = identity
        else:
            inputs = xp.concatenate([response, identity], axis=-1)

        sd = space.noise_sd
        if sd.shape[-1] > 1:
            sd = xp.tile(sd, (1, 1, n_bounds))
        if sd.shape[1] > 1:  # each robot has its own noise
            sd = xp.tile(sd, (1, layout.shape[0], 1))
        if np.ndim(noise):
            sd = sd * layout.rows(xp.broadcast_to(noise, (len(noise), *layout.shape)))

        shared = space.shared_cov
        if shared is not None:
            shared = repeat_diagonal(shared, n_bounds)
        return cls(mean, inputs, cov, sd, shared)

    @property
    def covariance(self) -> Any:
        """Covariance (point, label, row, row) of trust plus shared noise."""
        if self.shared_cov is None:
            return self.trust_cov
        return self.trust_cov + self.shared_cov

    def take(self, index: Any) -> Self:
        """Select points by an index array, a mask or a slice."""
        return type(self)(*(None if value is None else value[index] for value in self))

    def mean_given(self, inputs: Any, label: np.ndarray) -> Any:
        """Compute the mean (point, block, row) given inputs (point, block, input) of all blocks."""
        if self.response.shape[1] == 1:  # one product for all blocks is faster
            return each(self.mean, label) + inputs @ np.swapaxes(self.response[:, 0], 1, 2)
        return each(self.mean, label) + (self.response[:, label] @ inputs[..., None])[..., 0]


def rate_precision(seen: np.ndarray, noise_sd: Any, first: np.ndarray) -> Any:
    """Return the precisions (point, kind, row) of Gaussian rates, 0 where not measured.

    Args:
        seen: 1 where a rate was measured, otherwise 0, shape (kind, row).
        noise_sd: See `LinearPredictor`.
        first: Number of the first block of each kind, shape (kind,).
    """
    return seen / each(noise_sd, first) ** 2


def each(M: Any, label: np.ndarray) -> Any:
    """Select values (point, block, ...) by block label; a block axis of length 1 is kept."""
    return M if M.shape[1] == 1 else M[:, label]
