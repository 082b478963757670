"""`trustbo study`: many campaigns, on all cores."""

from importlib.util import find_spec
from pathlib import Path

import typer

from trustbo.cli.errors import FAILED, one_line_errors
from trustbo.cli.outputs import use_no_screen, write_figure


def study(
    config: Path,
    out: Path = Path("out/study"),
    executor: str | None = None,
    workers: int | None = None,
    quiet: bool = False,
    debug: bool = False,
) -> None:
    """Run a study: policies x objectives x models x seeds x terrains, on all cores.

    Example: trustbo study config.yaml --out out/study

    The folder gets a file for each run, summary.csv (for each policy and mission the
    regret, or the plan's value where no truth is known) and regret.png. The same
    command again runs the rest.
    """
    use_no_screen()
    with one_line_errors(debug):
        from trustbo import plots
        from trustbo.files import write_text
        from trustbo.spreadsheet import frame_as_csv
        from trustbo.study import run_study, summary
        from trustbo.study.store import Store
        from trustbo.study.table import axes_of

        Store(out).require_free("summary.csv", "regret.png")
        if executor is None:
            executor = "loky" if find_spec("loky") else "serial"
        results = run_study(config, out, executor, n_workers=workers, progress=not quiet)
        known = bool(results["regret"].notnull().any())
        table = summary(results, variable="regret" if known else "value")
        write_text(out / "summary.csv", frame_as_csv(table))
        if known:
            others = [name for name in axes_of(results) if name != "policy"]
            axes = plots.regret_curves(results, panels=others[0] if others else None)
            write_figure(out / "regret.png", axes)
        if not quiet:
            print(f"median {'regret' if known else 'value'} after each mission")
            print(table["median"].unstack("mission").round(4).to_string())
        print(f"results are in {out}/; in Python: trustbo.study.load_study({str(out)!r})")
    if results.attrs["n_failed"]:
        raise typer.Exit(FAILED)
