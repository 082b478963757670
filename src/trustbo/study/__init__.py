"""Studies: many campaigns as a table of runs, on as many cores as there are."""

from trustbo.study.benchmark import run_worlds
from trustbo.study.configuration import Study, run_study
from trustbo.study.experiment import failures, load_study
from trustbo.study.replicate import replicate
from trustbo.study.table import summary, worlds_table
from trustbo.study.world_set import worlds

__all__ = [
    "Study", "failures", "load_study", "replicate", "run_study", "run_worlds", "summary", "worlds",
    "worlds_table",
]  # fmt: skip
__dir__ = __all__.copy  # completion lists public names alone
