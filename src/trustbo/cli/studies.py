"""`trustbo worlds`: many campaigns, on all cores."""

from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from trustbo.campaign.options import OBJECTIVE, POLICY
from trustbo.cli.errors import FAILED

if TYPE_CHECKING:
    import xarray as xr


def worlds(
    data: Path | None = None,
    world: list[str] | None = None,
    kind: list[str] | None = None,
    policy: list[str] | None = None,
    model: list[str] | None = None,
    simulator: str | None = None,
    baseline: list[str] | None = None,
    objective: str = OBJECTIVE,
    max_bounds: str = "shortest+4",
    iterations: int = 15,
    seeds: int = 1,
    by: str = "method",
    quick: bool = False,
    out: Path = Path("out/worlds"),
    executor: str | None = None,
    workers: int | None = None,
    quiet: bool = False,
) -> None:
    """Compare policies, models and baselines on worlds whose truth is known.

    Example: trustbo worlds --data terrain/ --policy optimistic --policy mine:policy

    The folder gets a file for each campaign, and worlds.csv. Run the command again
    to resume. A policy, model, baseline or simulator of the user is named module:name.
    """
    from trustbo.files import write_text
    from trustbo.spreadsheet import frame_as_csv
    from trustbo.study.benchmark import run_worlds
    from trustbo.study.methods import BASELINES
    from trustbo.study.store import Store
    from trustbo.study.table import as_text, worlds_table

    Store(out).require_free("worlds.csv")
    chosen = {
        "policies": policy or (POLICY,),
        "models": model or ("robots",),
        "baselines": BASELINES if baseline is None else [b for b in baseline if b != "none"],
    }
    results = run_worlds(
        out, data=data, only=world, kinds=kind, simulator=simulator, objective=objective,
        max_bounds=int(max_bounds) if max_bounds.isdigit() else max_bounds,
        n_iterations=iterations, seeds=seeds, quick=quick,
        executor=executor or ("serial" if quick else _usual_executor()),
        n_workers=workers, progress=not quiet, **chosen,
    )  # fmt: skip
    table = worlds_table(results, by)
    write_text(out / "worlds.csv", frame_as_csv(table))
    if not quiet:
        print(as_text(table))
    _end(results, out)


def _usual_executor() -> str:
    return "loky" if find_spec("loky") else "serial"


def _end(results: "xr.Dataset", out: Path) -> None:
    """Print the folder, and end the command with FAILED if a run did."""
    print(f"results are in {out}/; in Python: trustbo.study.load_study({str(out)!r})")
    if results.attrs["n_failed"]:
        raise typer.Exit(FAILED)
