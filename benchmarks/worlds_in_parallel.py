"""Run campaigns of worlds in processes, with progress and an estimate of the end."""

import sys
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from joblib import Parallel, delayed, parallel_config
from threadpoolctl import threadpool_limits
from world_set import World

from trustbo.files import write_text

_DECIMALS = 5

type Rows = Iterable[Mapping[str, Any]]


def rows_of_worlds(
    rows_of: Callable[[World], Rows], some: Sequence[World], n_jobs: int, folder: Path
) -> pd.DataFrame:
    """Return the rows that `rows_of` yields for each world.

    Each world has a file in the folder, so a run that was stopped continues where it was. Exits if
    there was an error in a world, after all others.
    """
    errors = run_worlds(_write_rows, some, n_jobs, rows_of, folder)
    if errors:
        raise SystemExit("\n".join(["rows are missing:", *errors]))
    return pd.concat([pd.read_csv(_file_of(world, folder)) for world in some], ignore_index=True)


def _write_rows(world: World, rows_of: Callable[[World], Rows], folder: Path) -> int:
    """Write the rows of a world, unless it has a file; return how many."""
    file = _file_of(world, folder)
    if file.exists():
        return 0

    with warnings.catch_warnings(), threadpool_limits(1):
        warnings.simplefilter("ignore")  # of risk, and of bounds without contact
        rows = pd.DataFrame(rows_of(world)).round(_DECIMALS)
    folder.mkdir(parents=True, exist_ok=True)
    write_text(file, rows.to_csv(index=False))
    return len(rows)


def _file_of(world: World, folder: Path) -> Path:
    return folder / f"{world.name}.csv"


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
