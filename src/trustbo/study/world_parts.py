"""Worlds as parts of runs: a course through a world, and the simulator of its truth."""

from dataclasses import dataclass
from typing import Any

from trustbo.data import Cell
from trustbo.errors import TrustboError
from trustbo.planning import Planner
from trustbo.simulation import Simulator, Truth
from trustbo.study.contenders import identity_of, resolved
from trustbo.study.parts import Simulating
from trustbo.study.terrains import Terrain
from trustbo.study.world import Simulate, World
from trustbo.workspace import Workspace


@dataclass(frozen=True, kw_only=True)
class WorldCourse(Terrain):
    """Workspace of a world, and the ends of a course; `judged` is what regret is held against."""

    kind = "world"
    world: World
    course: str
    bounds: bool = True
    judged: tuple[str, int | str] = ("lost_contact", "shortest+4")

    @property
    def ends(self) -> tuple[Cell, Cell]:
        """Start and goal."""
        return self.world.ends(self.course)

    def identity(self) -> dict[str, Any]:
        """Settings that the numbers depend on."""
        return {
            "kind": self.kind,
            "world": self.world.identity(),
            "course": self.course,
            "bounds": self.bounds,
            "judged": self.judged,
        }

    def make(self) -> Workspace:
        """Take the world's workspace, which all its courses share."""
        return self.world.workspace(bounds=self.bounds)

    def judged_by(self, planner: Planner) -> dict[str, Any]:
        """Paths that regret is held against, the same for all contenders."""
        objective, max_bounds = self.judged
        return {
            "objective": "mean" if objective == "mean" else "lost_contact",
            "max_bounds": max_bounds,
            "connectivity": planner.connectivity,
        }


@dataclass(frozen=True, kw_only=True)
class InWorld(Simulating):
    """Simulator of a world; `own` is the user's, a function or the `"module:name"` of one."""

    kind = "world"
    own: Simulate | str | None = None

    def identity(self) -> dict[str, Any]:
        """Settings that the numbers depend on."""
        return {"kind": self.kind, "own": identity_of(self.own)}

    def simulator(self, place: Any) -> Simulator:
        """Make the simulator of the world of a `WorldCourse`."""
        return self.simulator_of(place.world, place.workspace())

    def truth(self, place: Any) -> Truth | None:
        """Find the truth of its world, whatever the awareness in the workspace."""
        return self.truth_of(place.world)

    def simulator_of(self, world: World, workspace: Workspace) -> Simulator:
        """Make the simulator of a world."""
        simulate = resolved("simulator", self.own)
        made: Any = world.simulator(workspace, simulate) if callable(simulate or str) else None
        if not callable(getattr(made, "run", None)):
            raise TrustboError(
                f"simulator {self.own!r} must be a function that makes a simulator from a "
                "workspace and the true terrain, sight and team."
            )
        return made

    def truth_of(self, world: World, *, progress: bool = False) -> Truth:
        """Find the truth of a world."""
        return Truth.of(self.simulator_of(world, world.workspace()), progress=progress)
