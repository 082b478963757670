"""Studies: grids of simulated campaigns in worlds with a known truth."""

from trustbo.study.grid import Scene, run_grid

__all__ = ["Scene", "run_grid"]
__dir__ = __all__.copy  # completion lists only public names
