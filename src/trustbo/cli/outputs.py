"""Figures, report and maps in the folder of a finished campaign."""

from pathlib import Path
from typing import TYPE_CHECKING

from trustbo.errors import TrustboError

if TYPE_CHECKING:
    from trustbo.campaign.result import Result

_FILES = (
    "report.html",
    "explore.html",
    "maps.png",
    "terrain.png",
    "maps.tif",
    "path.geojson",
)


def require_outputs(out: Path, *others: str, overwrite: bool) -> None:
    """Refuse a folder that cannot take the results, before any work.

    It need not exist yet; `others` are files written there in addition to those of `write_outputs`.
    TrustboError: it holds a campaign or a result, unless `overwrite`; its name belongs to a file,
    or the name of a file to a folder.
    """
    from trustbo.campaign.folder import RESULT, STATE
    from trustbo.files import require_file

    if not overwrite and (out / STATE).exists():
        raise TrustboError(
            f"{str(out)!r} holds a campaign: trustbo resume {out} goes on with it; give another "
            "--out, or --overwrite to replace it."
        )
    if not overwrite and (out / RESULT).exists():
        raise TrustboError(
            f"{str(out)!r} holds a result; give another --out, or --overwrite to replace it."
        )
    for name in (*_FILES, *others):
        require_file(out / name)


def write_outputs(result: "Result", out: Path, *, table: bool) -> None:
    """Write figures, report and maps to the folder `out` of a result, and print their names.

    With `table`, a row for each mission is printed too. TrustboError: the folder's name belongs to
    a file.
    """
    use_no_screen()
    from trustbo import plots
    from trustbo.report import write_report

    written = ["report.html", "explore.html", "maps.png"]
    write_figure(out / "maps.png", result.plot_maps())
    on_terrain = result.workspace.terrain is not None
    if on_terrain and result.workspace.pixels is not None:
        write_figure(out / "terrain.png", plots.terrain_maps(result.workspace))
        written.append("terrain.png")
    if on_terrain:  # else the maps have no place on Earth
        from trustbo.export import export_result

        written += [file.name for file in export_result(result, out, ("geotiff", "geojson"))]
    write_report(out / "report.html", result)
    if table:
        _print_table(result)
    print(f"results are in {out}/: {', '.join(written)},")
    print(f"posterior.nc, history.csv; in Python: trustbo.load_result({str(out)!r})")


def use_no_screen() -> None:
    """Draw into files, whether or not there is a display."""
    import matplotlib as mpl

    mpl.use("Agg")


def write_figure(path: Path, axes) -> None:
    """Write the figure that holds these Axes, and let go of it."""
    import matplotlib.pyplot as plt
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    from trustbo.files import write_file

    figure = axes[0].figure
    figure.set_dpi(150)
    # The same bytes as of `savefig`, which draws once more to know its layout.
    write_file(path, lambda file: FigureCanvasAgg(figure).print_png(file))
    plt.close(figure)


def _print_table(result: "Result") -> None:
    """Print one line for each mission, and the recommended path."""
    table = result.table()
    name, label = ("r_hat", "R-hat") if "r_hat" in table else ("k_hat", "k-hat")
    print(f"mission  status  contact  objective  {label}  path")
    for i, lost, row in zip(table.index, table.index.isna(), table.to_dict("records"), strict=True):
        if lost:
            where = f" at {row['where']}" if row["where"] else ""
            print(f"      -  given up: {row['reason']}{where}")
            continue
        change = "first" if i == 1 else "changed" if row["path_changed"] else "same"
        print(
            f"{i:7d}  {row['status']:6s}  {row['contact_rate']:7.3f}  "
            f"{row['objective']:9.3f}  {row[name]:5.3f}  {change}"
        )
    print(f"stopped: {result.stop_reason}")
    print(f"recommended: {' '.join(f'{row},{col}' for row, col in result.path)}")
    print(f"objective {result.value:.3f} ({result.settings['objective']})")
