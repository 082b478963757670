"""A simulator that is the trust model itself: the truth is known, and so is the best path."""

from collections.abc import Sequence

import jax
import numpy as np
from numpy.typing import ArrayLike

from trustbo.data import Cell, Mission
from trustbo.errors import ShapeError, TrustboError, require_whole
from trustbo.models import PooledTrust, TrustModel
from trustbo.models.params import Params, check_params
from trustbo.terrain import Workspace

_BUCKET = 8  # bounds: missions of about the same length share compiled code


class ModelSimulator:
    """Draws contact rates from a trust model with given parameters.

    With it, what a campaign learns and plans can be held against the truth: `params` and
    `awareness` say what a path is worth, and `Planner.plan(params)` which is best.
    """

    def __init__(
        self,
        workspace: Workspace,
        params: Params,
        model: TrustModel | None = None,
        *,
        awareness: ArrayLike | None = None,
        exposure: int | None = None,
    ) -> None:
        """Set up.

        Args:
            workspace: Where.
            params: The true parameters, one draw of them.
            model: What they are parameters of; by default `PooledTrust()`. Its Gaussian rates are
                cut to [0, 1], as rates are; where much is cut, the model is no longer quite true.
            awareness: The true awareness, shape (robot, row, col, feature), where the workspace's
                map is wrong; missions measure it where they pass.
            exposure: Ticks of each bound, for `"beta_binomial"`.

        Raises:
            ShapeError: Parameters or awareness of other robots or features, or of many draws.
            TrustboError: An exposure that is no number of ticks, or is missing.
        """
        self.workspace, self.params = workspace, params
        self.model = PooledTrust() if model is None else model
        shape = workspace.awareness.shape
        self.awareness = workspace.awareness.values if awareness is None else np.asarray(awareness)
        if self.awareness.shape != shape:
            raise ShapeError(f"awareness must be {shape}; got shape {self.awareness.shape}.")
        if params.leading:
            raise ShapeError(f"give one draw of params; they have leading axes {params.leading}.")
        check_params(params, shape[0], shape[3])
        self.exposure = None if exposure is None else require_whole("exposure", exposure, 1)
        if self.exposure is None and self.model.observation == "beta_binomial":
            raise TrustboError("the beta-binomial family counts ticks: give exposure.")

    def run(self, path: Sequence[Cell], *, seed: int) -> Mission:
        """The mission over a path; the same seed gives the same mission."""
        cells = [self.workspace.require_cell(f"path[{k}]", cell) for k, cell in enumerate(path)]
        z = np.swapaxes(self.awareness[:, *zip(*cells[1:], strict=True)], 0, 1)
        n_bounds = len(z)
        padded = np.concatenate([z, np.repeat(z[-1:], -n_bounds % _BUCKET, axis=0)])
        sample = self.model.simulate(jax.random.key(seed), self.params, padded[None], self.exposure)
        rates = np.clip(sample.contact_rate[0, :n_bounds], 0.0, 1.0)
        features, robots = (self.workspace.awareness[n].values for n in ("feature", "robot"))
        ticks = None if self.exposure is None else np.full(rates.shape, self.exposure)
        return Mission.from_arrays(
            cells,
            z,
            rates,
            exposure=ticks,
            features=tuple(str(name) for name in features),
            robots=tuple(str(name) for name in robots),
        )

    def describe(self) -> dict[str, object]:
        """The truth, for the record."""
        truth = {name: np.asarray(value).tolist() for name, value in self.params._asdict().items()}
        return {
            "simulator": type(self).__name__,
            "simulator_model": self.model.describe(),
            "truth": truth,
        }
