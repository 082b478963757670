"""Run campaigns of worlds in processes, with progress and an estimate of the end."""

import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

from joblib import Parallel, delayed, parallel_config
from world_set import World


def run_worlds(
    run_world: Callable[..., int], some: Sequence[World], n_jobs: int, *arguments: Any
) -> list[str]:
    """Call `run_world(world, *arguments)` for each world; return the errors.

    `run_world` returns how many campaigns it has run, of those that had no file yet.
    """
    with parallel_config("loky", inner_max_num_threads=1):
        jobs = Parallel(n_jobs, return_as="generator_unordered")(
            delayed(_try)(run_world, world, *arguments) for world in some
        )
        return list(_reported(jobs, len(some)))


def _try(run_world: Callable[..., int], world: World, *arguments: Any) -> tuple[int, str]:
    """Call `run_world`; an error in one world, which is returned, does not stop the others."""
    try:
        return run_world(world, *arguments), ""
    except Exception as error:
        return 0, f"{world.name}: {type(error).__name__}: {error}"


def _reported(jobs: Iterable[tuple[int, str]], n_worlds: int) -> Iterator[str]:
    """Print the progress and the estimated end after each world; yield the errors."""
    began = time.time()
    n_run = 0  # worlds of which some campaign had no file
    for k, (n_campaigns, error) in enumerate(jobs, start=1):
        if error:
            print(error, file=sys.stderr, flush=True)
            yield error
        if not n_campaigns:
            continue

        n_run += 1
        passed = time.time() - began
        end = time.localtime(time.time() + passed / n_run * (n_worlds - k))
        state = f"{k} of {n_worlds} worlds after {passed / 60.0:.0f} min"
        print(
            f"{state}, end at about {time.strftime('%d %H:%M', end)}", file=sys.stderr, flush=True
        )
