"""Studies: many campaigns as a table of runs, on as many cores as there are."""

from trustbo.study.conduct import failures, load_study, run_study
from trustbo.study.configuration import Study, read_study
from trustbo.study.table import axes_of, summary

__all__ = ["Study", "axes_of", "failures", "load_study", "read_study", "run_study", "summary"]
