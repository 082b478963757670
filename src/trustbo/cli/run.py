"""`trustbo run`: a campaign on one's own terrain."""

from pathlib import Path
from typing import TYPE_CHECKING

from trustbo.cli import options
from trustbo.cli.errors import one_line_errors
from trustbo.cli.outputs import require_outputs, write_outputs
from trustbo.errors import TrustboError, require_choice, require_whole

if TYPE_CHECKING:
    from trustbo.data import Team
    from trustbo.models import TrustModel


def run(
    dem: options.Dem,
    dsm: options.Dsm,
    start: options.Start,
    goal: options.Goal,
    shape: options.Shape = "10,10",
    crs: options.Crs = None,
    resolution: options.Resolution = None,
    robots: options.Robots = 3,
    max_slope: options.MaxSlope = 45.0,
    lidar_range: options.LidarRange = 100.0,
    sight: options.SightMode = "transmittance",
    objective: options.Objective = "terminal",
    team: options.TeamTrust = "mean",
    connectivity: options.Connectivity = 8,
    max_bounds: options.MaxBounds = None,
    policy: options.Policy = "greedy",
    model: options.Model = "pooled",
    observation: options.Observation = "gaussian",
    sampler: options.Sampler = "nuts",
    awareness: options.Awareness = "map",
    iterations: options.Iterations = 8,
    stop_regret: options.StopRegret = None,
    replan: options.Replan = "mission",
    seed: options.Seed = 0,
    config: options.Config = None,
    out: options.Out = Path("out"),
    overwrite: options.Overwrite = False,
    quiet: options.Quiet = False,
    debug: options.Debug = False,
) -> None:
    """Run a campaign on your own terrain: plan, simulate, learn, and plan again.

    Example: trustbo run --dem dem.tif --dsm dsm.tif --start 9,0 --goal 0,9
    The same, with flags in a file: trustbo run --config mission.yaml --seed 2 --out out/second

    The folder gets report.html (read this first), maps.png, terrain.png, maps.tif
    with its style maps.qml and path.geojson (for QGIS), posterior.nc (for ArviZ),
    history.csv, and the rest of the result for trustbo.load_result in Python.
    Interrupted by Ctrl-C or a power cut, it goes on by trustbo resume. A campaign
    that the folder holds already is kept: give another --out, or --overwrite.
    """
    with one_line_errors(debug, campaign=out):
        require_names(
            policy, objective, model, sampler, sight, awareness, team, replan,
            iterations=iterations, seed=seed,
        )  # fmt: skip
        require_outputs(out, overwrite=overwrite)
        trust_model, who = _model(model, observation), _team(robots, max_slope, lidar_range)
        cells = _pair("start", start), _pair("goal", goal)
        rows_cols = _pair("shape", shape)
        from trustbo import simulation, terrain
        from trustbo.loop import iterate
        from trustbo.stopping import RegretBound

        stop = None if stop_regret is None else RegretBound(eps=stop_regret)
        ground = terrain.read_terrain(dem, dsm, crs=crs, resolution=resolution)
        workspace = terrain.Workspace.from_terrain(ground, rows_cols, who)
        result = iterate(
            workspace,
            *cells,
            n_iterations=iterations,
            model=trust_model,
            policy=policy,
            objective=objective,
            sampler=sampler,
            simulator=simulation.KinematicSimulator(workspace, sight=sight),
            connectivity=connectivity,
            max_bounds=_bounds(max_bounds),
            team=team,
            awareness=awareness,
            replan=replan,
            stop=stop,
            checkpoint=out,
            seed=seed,
            progress=not quiet,
        )
        write_outputs(result, out, table=not quiet)


def require_names(
    policy: str,
    objective: str,
    model: str,
    sampler: str,
    sight: str = "bare",
    awareness: str = "map",
    team: str = "mean",
    replan: str = "mission",
    *,
    iterations: int,
    seed: int,
) -> None:
    """Refuse bad names and numbers before any raster is read or written.

    Raises:
        TrustboError: A name there is not, or a number that cannot be.
    """
    from trustbo.campaign import AWARENESS
    from trustbo.models.sampling import SAMPLERS
    from trustbo.planning import OBJECTIVES, POLICIES
    from trustbo.replanning import REPLAN
    from trustbo.simulation import SIGHT_MODES

    for what, name, choices in (
        ("policy", policy, POLICIES),
        ("objective", objective, OBJECTIVES),
        ("model", model, _MODELS),
        ("sampler", sampler, SAMPLERS),
        ("sight mode", sight, SIGHT_MODES),
        ("awareness", awareness, AWARENESS),
        ("team", team, ("mean", "min")),
        ("replan", replan, REPLAN),
    ):
        require_choice(what, name, choices)
    require_whole("n_iterations", iterations, 1)
    require_whole("seed", seed, 0)


_MODELS = {"pooled": "PooledTrust", "hierarchical": "HierarchicalTrust", "coupled": "CoupledTrust"}


def _model(name: str, observation: str) -> "TrustModel":
    from trustbo import models

    return getattr(models, _MODELS[name])(observation=observation)


def _team(n_robots: int, max_slope: float, lidar_range: float) -> "Team":
    """Robots all alike; the slope is in degrees."""
    from math import radians

    from trustbo.data import Robot, Team

    if not 0.0 < max_slope < 90.0:
        raise TrustboError(f"--max-slope must be between 0 and 90 degrees; got {max_slope:g}.")
    require_whole("n_robots", n_robots, 1)
    robot = Robot(max_slope=radians(max_slope), lidar_range=lidar_range)
    return Team(robots=(robot,) * n_robots, lead=robot)


def _pair(what: str, text: str) -> tuple[int, int]:
    try:
        first, second = (int(part) for part in text.split(","))
    except ValueError:
        raise TrustboError(f"--{what} must be two whole numbers as 9,0; got {text!r}.") from None
    return first, second


def _bounds(text: str | None) -> int | str | None:
    return int(text) if text is not None and text.isdigit() else text
