"""The command line: `trustbo run` on your own terrain, `demo` on a made one, `study` on many."""

import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Learn how trustworthy robots are where, and plan the most trustworthy path.",
)
Out = Annotated[Path, typer.Option("--out", help="Folder for the results; made if need be.")]
Policy = Annotated[
    str,
    typer.Option(
        help="How the next path is chosen: greedy, optimistic, thompson, information, ucb, ei, "
        "epsilon_greedy, cvar, random."
    ),
]
Objective = Annotated[
    str,
    typer.Option(
        help="What makes a path good: terminal (as the paper), mean, success, bottleneck, "
        "stationary."
    ),
]
Iterations = Annotated[int, typer.Option(help="How many missions to run and learn from.")]
Seed = Annotated[int, typer.Option(help="Same seed, same result.")]
Quiet = Annotated[bool, typer.Option("--quiet", help="No progress bar, no table.")]
Debug = Annotated[bool, typer.Option("--debug", help="Show the whole traceback of an error.")]


@app.command()
def run(
    dem: Annotated[Path, typer.Option(help="Digital elevation model (ground), e.g. a GeoTIFF.")],
    dsm: Annotated[Path, typer.Option(help="Digital surface model (canopy), same place.")],
    start: Annotated[str, typer.Option(help="First cell as row,col; row 0 is the top (north).")],
    goal: Annotated[str, typer.Option(help="Last cell as row,col.")],
    shape: Annotated[str, typer.Option(help="Planning grid as rows,cols.")] = "10,10",
    policy: Policy = "greedy",
    objective: Objective = "terminal",
    iterations: Iterations = 8,
    seed: Seed = 0,
    sampler: Annotated[
        str, typer.Option(help="nuts, or exact: importance sampling, which need not compile.")
    ] = "nuts",
    robots: Annotated[int, typer.Option(help="Robots that overwatch the lead.")] = 3,
    max_slope: Annotated[float, typer.Option(help="Steepest slope they stand, degrees.")] = 45.0,
    lidar_range: Annotated[float, typer.Option(help="How far they track each other, m.")] = 100.0,
    sight: Annotated[
        str, typer.Option(help="What blocks sight: bare ground, wall (canopy too), transmittance.")
    ] = "transmittance",
    connectivity: Annotated[int, typer.Option(help="8, or 4 for no diagonal bounds.")] = 8,
    max_bounds: Annotated[
        str | None,
        typer.Option(
            help="Which paths are admissible: shortest, shortest+2, or the most bounds allowed."
        ),
    ] = None,
    crs: Annotated[
        str | None, typer.Option(help="CRS of rasters that carry none, e.g. EPSG:32633.")
    ] = None,
    resolution: Annotated[
        float | None, typer.Option(help="Pixel size of rasters without georeference, m.")
    ] = None,
    out: Out = Path("out"),
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Run a campaign on your own terrain: plan, simulate, learn, and plan again.

    Example: trustbo run --dem dem.tif --dsm dsm.tif --start 9,0 --goal 0,9 --out out/mine

    The folder gets posterior.nc (ArviZ), history.csv, maps.png, terrain.png, trust_map.tif (opens
    in QGIS over the DEM), path.geojson, and the rest of the result for trustbo.load_result.
    """
    import numpy as np

    from trustbo import simulation, terrain
    from trustbo.data import Robot, Team
    from trustbo.errors import TrustboError, require_choice

    with _one_line_errors(debug):
        _check(policy, objective, iterations, seed)
        if not 0.0 < max_slope < 90.0:
            raise TrustboError(f"--max-slope must be between 0 and 90 degrees; got {max_slope:g}.")
        robot = Robot(max_slope=float(np.deg2rad(max_slope)), lidar_range=lidar_range)
        team = Team(n_robots=robots, robots=(robot,) * robots, lead=robot)
        require_choice("sight mode", sight, simulation.SIGHT_MODES)
        cells = _pair("start", start), _pair("goal", goal)
        ground = terrain.read_terrain(dem, dsm, crs=crs, resolution=resolution)
        workspace = terrain.Workspace.from_terrain(ground, _pair("shape", shape), team)
        if max_bounds is not None and max_bounds.isdigit():
            max_bounds = int(max_bounds)  # pyright: ignore[reportAssignmentType]
        _campaign(
            workspace,
            *cells,
            out,
            n_iterations=iterations,
            policy=policy,
            objective=objective,
            sampler=sampler,
            simulator=simulation.KinematicSimulator(workspace, sight=sight),
            connectivity=connectivity,
            max_bounds=max_bounds,
            seed=seed,
            progress=not quiet,
        )


@app.command()
def demo(
    policy: Policy = "greedy",
    objective: Objective = "mean",
    iterations: Iterations = 8,
    seed: Seed = 0,
    out: Out = Path("out/demo"),
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Run the same on a made terrain of 500 m x 500 m, whose DEM and DSM are written out too.

    The objective is the mean trust on the way, which makes for a telling picture; the paper's, the
    default of `run`, is trust at the goal, which the last few bounds decide.
    """
    from trustbo import terrain
    from trustbo.files import write_file
    from trustbo.result import require_folder

    with _one_line_errors(debug):
        _check(policy, objective, iterations, seed)
        require_folder(out)
        ground = terrain.synthetic_terrain(seed=seed)
        for name in ("dem", "dsm"):
            raster = ground[name].astype("float32")
            write_file(out / f"{name}.tif", raster.rio.to_raster)
    run(
        dem=out / "dem.tif",
        dsm=out / "dsm.tif",
        start="9,0",
        goal="0,9",
        policy=policy,
        objective=objective,
        iterations=iterations,
        seed=seed,
        out=out,
        quiet=quiet,
        debug=debug,
    )


@app.command()
def study(
    config: Annotated[Path, typer.Argument(help="The study, in YAML; see docs/studies.md.")],
    out: Out = Path("out/study"),
    executor: Annotated[
        str, typer.Option(help="serial, loky, dask, or a scheduler's address, tcp://host:8786.")
    ] = "loky",
    workers: Annotated[
        int | None, typer.Option(help="Processes of loky or dask; by default one for each core.")
    ] = None,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Run a study: policies x objectives x models x seeds x terrains, on all cores.

    Example: trustbo study config.yaml --out out/mine

    The folder gets a file for each run, summary.csv (regret, or the plans' value where no truth is
    known, per policy and mission), and regret.png. Called again, it goes on where it stopped.
    """
    import matplotlib as mpl

    mpl.use("Agg")
    from trustbo import plots
    from trustbo.files import write_file, write_text
    from trustbo.study import axes_of, run_study, summary

    with _one_line_errors(debug):
        results = run_study(config, out, executor, n_workers=workers, progress=not quiet)
        known = bool(results["regret"].notnull().any())
        table = summary(results, variable="regret" if known else "value")
        write_text(out / "summary.csv", table.to_csv())
        if known:
            others = [name for name in axes_of(results) if name != "policy"]
            axes = plots.regret_curves(results, panels=others[0] if others else None)
            write_file(out / "regret.png", lambda file: axes[0].figure.savefig(file, dpi=150))
        if not quiet:
            print(f"median {'regret' if known else 'value'} after each mission")
            print(table["median"].unstack("mission").round(4).to_string())
        print(f"results are in {out}/; in Python: trustbo.study.load_study({str(out)!r})")
    if results.attrs["n_failed"]:
        raise typer.Exit(1)


def _campaign(
    workspace,
    start: tuple[int, int],
    goal: tuple[int, int],
    out: Path,
    *,
    progress: bool,
    **options,
) -> None:
    """Run, then write and report everything."""
    import matplotlib as mpl

    mpl.use("Agg")
    from trustbo import export, plots
    from trustbo.files import write_file
    from trustbo.loop import iterate

    result = iterate(workspace, start, goal, checkpoint=out, progress=progress, **options)
    for name, axes in (
        ("maps.png", plots.trust_maps(result)),
        ("terrain.png", plots.terrain_maps(workspace)),
    ):
        write_file(out / name, lambda file, axes=axes: axes[0].figure.savefig(file, dpi=150))
    export.write_cell_map(out / "trust_map.tif", result.trust_map, workspace, name="expected trust")
    export.write_path(out / "path.geojson", result)
    if progress:
        _report(result)
    print(f"results are in {out}/: maps.png, terrain.png, trust_map.tif, path.geojson,")
    print("posterior.nc, history.csv; in Python: trustbo.load_result(" + repr(str(out)) + ")")


def _check(policy: str, objective: str, iterations: int, seed: int) -> None:
    """Refuse bad names and numbers before any raster is read or written."""
    from trustbo.errors import require_choice, require_whole
    from trustbo.planning import OBJECTIVES, POLICIES

    require_choice("policy", policy, POLICIES)
    require_choice("objective", objective, OBJECTIVES)
    require_whole("n_iterations", iterations, 1)
    require_whole("seed", seed, 0)


def _report(result) -> None:
    """One line per mission, and what was learned."""
    name, label = ("r_hat", "R-hat") if "r_hat" in result.history else ("k_hat", "k-hat")
    print(f"mission  status  contact  objective  {label}  path")
    for i in result.history["iteration"].values:
        row = result.history.sel(iteration=i)
        change = "first" if i == 1 else "changed" if row["path_changed"] else "same"
        print(
            f"{i:7d}  {row['status'].item():6s}  {row['contact_rate'].item():7.3f}  "
            f"{row['objective'].item():9.3f}  {row[name].item():5.3f}  {change}"
        )
    print(f"recommended: {' '.join(f'{row},{col}' for row, col in result.path)}")
    print(f"objective {result.value:.3f} ({result.settings['objective']})")


def _pair(what: str, text: str) -> tuple[int, int]:
    from trustbo.errors import TrustboError

    try:
        first, second = (int(part) for part in text.split(","))
    except ValueError:
        raise TrustboError(f"--{what} must be two whole numbers as 9,0; got {text!r}.") from None
    return first, second


@contextmanager
def _one_line_errors(debug: bool) -> Iterator[None]:
    """Print bad input's message without a traceback and exit with 2; warnings in a line each."""
    from trustbo.errors import TrustboError

    def show(message, category, filename, lineno, file=None, line=None) -> None:
        print(f"warning: {message}", file=sys.stderr)

    with warnings.catch_warnings():
        warnings.showwarning = show
        warnings.simplefilter("default", UserWarning)
        try:
            yield
        except (TrustboError, OSError) as error:
            if debug:
                raise
            print(f"error: {error}", file=sys.stderr)
            raise typer.Exit(2) from None


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point."""
    app(arguments)


if __name__ == "__main__":
    main()
