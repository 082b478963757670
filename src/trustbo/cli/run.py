"""`trustbo run`: a campaign on your own terrain."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from trustbo.campaign.options import OBJECTIVE, POLICY, SAMPLER, CampaignOptions
from trustbo.cli.errors import one_line_errors
from trustbo.cli.outputs import require_outputs, write_outputs
from trustbo.errors import TrustboError, require_choice, require_whole

if TYPE_CHECKING:
    from trustbo.data import Team

_MOST_PIXELS = 9e6
"""Of a raster: a campaign on it takes some 2 GB."""


def run(
    dem: Path,
    start: str,
    goal: str,
    dsm: Path | None = None,
    shape: str = "10,10",
    crs: str | None = None,
    resolution: float | None = None,
    nodata: float | None = None,
    robots: int = 3,
    max_slope: float = 45.0,
    lidar_range: float = 100.0,
    sight: str = "transmittance",
    objective: str = OBJECTIVE,
    policy: str = POLICY,
    model: str = "pooled",
    observation: str = "gaussian",
    sampler: str = SAMPLER,
    iterations: int = 8,
    stop_regret: float | None = None,
    seed: int = 0,
    config: Path | None = None,
    out: Path = Path("out"),
    overwrite: bool = False,
    quiet: bool = False,
    debug: bool = False,
    **options: Any,
) -> None:
    """Run a campaign on your own terrain: plan, simulate, learn, and plan again.

    Example: trustbo run --dem dem.tif --dsm dsm.tif --start 9,0 --goal 0,9
    The same, with flags in a file: trustbo run --config mission.yaml --seed 2 --out out/second

    The folder gets report.html (read this first), maps.png, terrain.png, maps.tif
    with its style maps.qml and path.geojson (for QGIS), posterior.nc (for ArviZ),
    history.csv, and the other files that trustbo.load_result reads in Python.
    After Ctrl-C or a power cut, trustbo resume goes on. A campaign in the folder
    is not replaced: give another --out, or --overwrite.
    """
    with one_line_errors(debug, campaign=out):
        require_names(policy, objective, model, sampler, sight, iterations=iterations, seed=seed)
        chosen = CampaignOptions(**options)
        require_outputs(out, overwrite=overwrite)
        trust_model = _models()[model](observation=observation).model()
        team = _team(robots, max_slope, lidar_range)
        cells = _pair("start", start), _pair("goal", goal)
        rows_cols = _pair("shape", shape)
        from trustbo import simulation, terrain
        from trustbo.campaign.loop import iterate
        from trustbo.campaign.stopping import RegretBound
        from trustbo.workspace import Workspace

        stop = None if stop_regret is None else RegretBound(eps=stop_regret)
        place = {"crs": crs, "resolution": resolution, "nodata": nodata}
        ground = terrain.read_terrain(
            dem, dsm, **place, max_pixels=_MOST_PIXELS, progress=not quiet
        )
        workspace = Workspace.from_terrain(ground, rows_cols, team)
        result = iterate(
            workspace,
            *cells,
            n_iterations=iterations,
            model=trust_model,
            policy=policy,
            objective=objective,
            sampler=sampler,
            simulator=simulation.KinematicSimulator(workspace, sight=sight),
            stop=stop,
            checkpoint=out,
            seed=seed,
            progress=not quiet,
            options=chosen,
        )
        write_outputs(result, out, table=not quiet)


def require_names(
    policy: str,
    objective: str,
    model: str,
    sampler: str,
    sight: str = "bare",
    *,
    iterations: int,
    seed: int,
) -> None:
    """Refuse unknown names and numbers out of range (TrustboError) before a raster is read."""
    from trustbo.models.samplers.run import SAMPLERS
    from trustbo.planning import OBJECTIVES, POLICIES
    from trustbo.workspace import SIGHT_MODES

    for what, name, choices in (
        ("policy", policy, POLICIES),
        ("objective", objective, OBJECTIVES),
        ("model", model, _models()),
        ("sampler", sampler, SAMPLERS),
        ("sight mode", sight, SIGHT_MODES),
    ):
        require_choice(what, name, choices)
    require_whole("n_iterations", iterations, 1)
    require_whole("seed", seed, 0)


def _models() -> dict[str, Any]:
    from trustbo.study.models import MODELS

    return {model.kind: model for model in MODELS}


def _team(n_robots: int, max_slope: float, lidar_range: float) -> "Team":
    """Make a team of equal robots; the slope is in degrees."""
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
