"""Studies: grids of simulated campaigns in worlds of known or unknown truth."""

from trustbo.study.grid import Scene, lost_in, run_grid

__all__ = ["Scene", "lost_in", "run_grid"]
__dir__ = __all__.copy  # completion lists only public names
