"""`trustbo worlds`: policies, models and baselines on the open benchmark."""

from importlib.util import find_spec
from pathlib import Path

import typer

from trustbo.campaign.options import OBJECTIVE, POLICY
from trustbo.cli.errors import FAILED, one_line_errors


def worlds(
    data: Path | None = None,
    world: list[str] | None = None,
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
    debug: bool = False,
) -> None:
    """Compare policies, models and baselines on worlds whose truth is known.

    Example: trustbo worlds --data terrain/ --policy optimistic --policy mine:policy

    The folder gets a file for each campaign, and worlds.csv. The same command again runs
    the rest. A policy, model, baseline or simulator of the user is named module:name.
    """
    with one_line_errors(debug):
        from trustbo.files import write_text
        from trustbo.spreadsheet import frame_as_csv
        from trustbo.study.benchmark import run_worlds
        from trustbo.study.methods import BASELINES
        from trustbo.study.store import Store
        from trustbo.study.table import as_text, worlds_table

        Store(out).require_free("worlds.csv")
        if executor is None:
            executor = "loky" if find_spec("loky") and not quick else "serial"
        chosen = {
            "policies": policy or (POLICY,),
            "models": model or ("places",),
            "baselines": BASELINES if baseline is None else [b for b in baseline if b != "none"],
        }
        results = run_worlds(
            out, data=data, only=world, simulator=simulator, objective=objective,
            max_bounds=int(max_bounds) if max_bounds.isdigit() else max_bounds,
            n_iterations=iterations, seeds=seeds, quick=quick, executor=executor,
            n_workers=workers, progress=not quiet, **chosen,
        )  # fmt: skip
        table = worlds_table(results, by)
        write_text(out / "worlds.csv", frame_as_csv(table))
        if not quiet:
            print(as_text(table))
        print(f"results are in {out}/; in Python: trustbo.study.load_study({str(out)!r})")
    if results.attrs["n_failed"]:
        raise typer.Exit(FAILED)
