"""Studies: many campaigns as a table of runs, on as many cores as there are."""

from trustbo.study.benchmark import run_worlds, worlds_table
from trustbo.study.conduct import failures, load_study, run_study
from trustbo.study.configuration import Study, read_study
from trustbo.study.table import summary
from trustbo.study.world import World
from trustbo.study.world_set import worlds

__all__ = [
    "Study", "World", "failures", "load_study", "read_study", "run_study", "run_worlds",
    "summary", "worlds", "worlds_table",
]  # fmt: skip
__dir__ = __all__.copy  # completion lists public names alone
