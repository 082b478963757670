"""Studies: grids of campaigns on worlds whose truth is known."""

from trustbo.study.grid import Scene, run_grid
from trustbo.study.summary import differences, numbers_of, summary
from trustbo.study.world_set import worlds

__all__ = ["Scene", "differences", "numbers_of", "run_grid", "summary", "worlds"]
__dir__ = __all__.copy  # completion lists public names alone
