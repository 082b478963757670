"""Studies: many campaigns as a table of runs, on as many cores as there are."""

from trustbo.study.benchmark import run_worlds, worlds
from trustbo.study.calls import random_workspace
from trustbo.study.configuration import Study, read_study, run_study
from trustbo.study.experiment import failures, load_study
from trustbo.study.table import summary, worlds_table
from trustbo.study.world import World

__all__ = [
    "Study", "World", "failures", "load_study", "random_workspace", "read_study", "run_study",
    "run_worlds", "summary", "worlds", "worlds_table",
]  # fmt: skip
__dir__ = __all__.copy  # completion lists public names alone
