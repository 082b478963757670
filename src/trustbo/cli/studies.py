"""`trustbo study` and `trustbo worlds`: many campaigns, on all cores."""

from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from trustbo.campaign.options import OBJECTIVE, POLICY
from trustbo.cli.errors import FAILED
from trustbo.cli.outputs import use_no_screen, write_figure

if TYPE_CHECKING:
    import xarray as xr


def study(
    config: Path,
    out: Path = Path("out/study"),
    executor: str | None = None,
    workers: int | None = None,
    quiet: bool = False,
) -> None:
    """Run a study: policies x objectives x models x seeds x terrains, on all cores.

    Example: trustbo study config.yaml --out out/study

    The folder gets a file for each run, summary.csv (for each policy and mission the
    regret, or the plan's value where no truth is known) and regret.png. Run the
    command again to resume.
    """
    use_no_screen()
    from trustbo import plots
    from trustbo.files import write_text
    from trustbo.spreadsheet import frame_as_csv
    from trustbo.study import run_study, summary
    from trustbo.study.store import Store
    from trustbo.study.table import axes_of

    Store(out).require_free("summary.csv", "regret.png")
    results = run_study(
        config, out, executor or _usual_executor(), n_workers=workers, progress=not quiet
    )
    has_regret = bool(results["regret"].notnull().any())
    table = summary(results, variable="regret" if has_regret else "value")
    write_text(out / "summary.csv", frame_as_csv(table))
    if has_regret:
        others = [name for name in axes_of(results) if name != "policy"]
        axes = plots.regret_curves(results, panels=others[0] if others else None)
        write_figure(out / "regret.png", axes)
    if not quiet:
        print(f"median {'regret' if has_regret else 'value'} after each mission")
        print(table["median"].unstack("mission").round(4).to_string())
    _end(results, out)


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
