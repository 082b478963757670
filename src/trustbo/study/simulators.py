"""Simulators of studies, as plain settings."""

from dataclasses import asdict, dataclass

import numpy as np

from trustbo import models, simulation
from trustbo.study.parts import Part
from trustbo.workspace import Workspace


@dataclass(frozen=True, kw_only=True)
class Simulating(Part):
    """Simulator that runs the paths."""

    def simulator(self, workspace: Workspace) -> simulation.Simulator:
        """Make the simulator."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class Kinematic(Simulating):
    """Settings of `simulation.KinematicSimulator`, which needs a terrain."""

    kind = "kinematic"
    sight: str = "transmittance"
    tick: float = 0.5
    formation_radius: float = 8.0
    bound_timeout: float = 600.0
    bounding: str = "successive"

    def simulator(self, workspace: Workspace) -> simulation.Simulator:
        """Make the simulator."""
        return simulation.KinematicSimulator(workspace, **asdict(self))


@dataclass(frozen=True, kw_only=True)
class FromModel(Simulating):
    """Settings of `simulation.ModelSimulator`: the pooled model with these true parameters."""

    kind = "model"
    REQUIRED = ("beta0", "beta", "b", "delta_w", "delta_v")
    beta0: float
    beta: tuple[float, ...]
    b: float
    delta_w: float
    delta_v: float
    x0_mean: float = 0.5
    x0_sd: float = 0.5
    observation: str = "gaussian"
    n_ticks: int | None = None

    def simulator(self, workspace: Workspace) -> simulation.Simulator:
        """Make the simulator."""
        own = asdict(self)
        n_ticks = own.pop("n_ticks")
        model = models.PooledTrust(observation=own.pop("observation"))
        truth = models.TrustParams(**own | {"beta": np.array(self.beta, dtype=float)})
        return simulation.ModelSimulator(workspace, truth, model, n_ticks=n_ticks)


SIMULATORS = (Kinematic, FromModel)
