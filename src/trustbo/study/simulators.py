"""What runs the paths of a study: simulators as plain settings."""

from dataclasses import asdict, dataclass

import numpy as np

from trustbo import models, simulation
from trustbo.study.parts import Part
from trustbo.terrain import Workspace


@dataclass(frozen=True, kw_only=True)
class Simulating(Part):
    """What runs the paths."""

    def simulator(self, workspace: Workspace) -> simulation.Simulator:
        """The simulator."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class Kinematic(Simulating):
    """`simulation.KinematicSimulator`; it needs a ground."""

    kind = "kinematic"
    sight: str = "transmittance"
    tick: float = 0.5
    formation_radius: float = 8.0
    bound_timeout: float = 600.0
    bounding: str = "successive"

    def simulator(self, workspace: Workspace) -> simulation.Simulator:
        """The simulator."""
        return simulation.KinematicSimulator(workspace, **asdict(self))


@dataclass(frozen=True, kw_only=True)
class FromModel(Simulating):
    """`simulation.ModelSimulator` of the pooled model with these true parameters."""

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
    exposure: int | None = None

    def simulator(self, workspace: Workspace) -> simulation.Simulator:
        """The simulator."""
        own = asdict(self)
        exposure, model = (
            own.pop("exposure"),
            models.PooledTrust(observation=own.pop("observation")),
        )
        truth = models.TrustParams(**own | {"beta": np.array(self.beta, dtype=float)})
        return simulation.ModelSimulator(workspace, truth, model, exposure=exposure)


SIMULATORS = (Kinematic, FromModel)
