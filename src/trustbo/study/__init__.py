"""Studies: grids of simulated campaigns in worlds with a known truth."""

from trustbo.study.grid import Scene, run_grid
from trustbo.study.summary import differences, numbers_of, summary
from trustbo.study.world_set import worlds

__all__ = ["Scene", "differences", "numbers_of", "run_grid", "summary", "worlds"]
__dir__ = __all__.copy  # completion lists only public names
