"""`trustbo run`, `demo` and `resume`: campaigns on a terrain of the user or of the package."""

from functools import partial
from pathlib import Path
from shutil import copyfile
from typing import TYPE_CHECKING, Any

from trustbo.campaign.options import OBJECTIVE, POLICY, SAMPLER
from trustbo.cli.options import choices_of
from trustbo.cli.outputs import require_outputs, write_outputs
from trustbo.cli.terrains import pair, reader_of, team_of, workspace_with
from trustbo.errors import TrustboError, require_choice, require_whole

if TYPE_CHECKING:
    from trustbo.models.model import TrustModel
    from trustbo.simulation import KinematicSimulator


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
    model: str = "robots",
    observation: str = "gaussian",
    sampler: str = SAMPLER,
    iterations: int = 8,
    stop_regret: float | None = None,
    seed: int = 0,
    out: Path = Path("out"),
    overwrite: bool = False,
    quiet: bool = False,
) -> None:
    """Run a campaign on a terrain of yours: plan, simulate, learn, and plan again.

    Example: trustbo run --dem dem.tif --dsm dsm.tif --start 9,0 --goal 0,9
    Ends where a map has them: --start lon=175.4007,lat=-40.9204 --goal x=1802403,y=5467480

    The folder gets report.html (read this first), explore.html (interactive),
    maps.png, terrain.png, maps.tif and path.geojson (for QGIS; with each robot's
    posts and ways), posterior.nc (for ArviZ), history.csv, and the other files that
    trustbo.load_result reads in Python. After Ctrl-C or a power cut, trustbo resume
    goes on. A campaign in the folder is not replaced: give another --out, or
    --overwrite.
    """
    _require_flags(
        iterations, seed, policy=policy, objective=objective, model=model, sampler=sampler,
        sight=sight, observation=observation,
    )  # fmt: skip
    cells, team = pair("shape", shape), team_of(max_slope, robots, lidar_range)
    require_outputs(out, overwrite=overwrite)
    trust_model = _model(model, observation)
    _require_sampler(trust_model, sampler)
    from trustbo import simulation
    from trustbo.campaign.loop import iterate
    from trustbo.campaign.stopping import RegretBound

    stop = None if stop_regret is None else RegretBound(eps=stop_regret)
    read = reader_of(dem, dsm, crs, resolution, nodata)
    workspace, ends = workspace_with(
        start, goal, read, cells, team, progress=not quiet, sight=sight
    )
    result = iterate(
        workspace, *ends, n_iterations=iterations, model=trust_model, policy=policy,
        objective=objective, sampler=sampler, simulator=simulation.KinematicSimulator(workspace),
        stop=stop, checkpoint=out, overwrite=overwrite, seed=seed, progress=not quiet,
    )  # fmt: skip
    write_outputs(result, out, table=not quiet)


def demo(
    policy: str = POLICY,
    objective: str = OBJECTIVE,
    model: str = "robots",
    sampler: str = SAMPLER,
    iterations: int = 8,
    seed: int = 0,
    out: Path = Path("out/demo"),
    overwrite: bool = False,
    quiet: bool = False,
) -> None:
    """Run a campaign on a real hillside, 195 m x 278 m, and write its DEM and DSM too.

    Example: trustbo demo --sampler exact --iterations 4 --out out/demo

    Then open out/demo/report.html, which links to explore.html, interactive. The
    objective is the contact lost on the way, which every bound changes; the
    paper's, terminal, is trust at the goal, which depends on the last few bounds.
    """
    given = dict(locals())
    from trustbo.files import write_file
    from trustbo.terrain.example import example_files

    _require_flags(
        iterations, seed, policy=policy, objective=objective, model=model, sampler=sampler
    )
    require_outputs(out, "dem.tif", "dsm.tif", overwrite=overwrite)
    for file in map(Path, example_files("wellington")):
        _require_same(out / file.name, file)
        write_file(out / file.name, partial(copyfile, file))
    run(dem=out / "dem.tif", dsm=out / "dsm.tif", start="9,0", goal="0,9", **given)


def resume(
    folder: Path,
    iterations: int | None = None,
    stop_regret: float | None = None,
    quiet: bool = False,
) -> None:
    """Go on with a campaign that was interrupted, or with more missions.

    Example: trustbo resume out/demo
    More missions, 12 in all: trustbo resume out/demo --iterations 12

    The result is the same as without the interruption. The folder keeps all flags but
    --stop-regret: give it again. A campaign that it has ended goes on with another
    --stop-regret, which is asked before anything is driven.
    """
    if iterations is not None:
        require_whole("n_iterations", iterations, 1)
    state = _state(folder)
    require_outputs(folder, overwrite=True)
    from trustbo.campaign.loop import resume as go_on
    from trustbo.campaign.stopping import RegretBound

    stop = None if stop_regret is None else RegretBound(eps=stop_regret)
    total = iterations or state["notes"]["n_iterations"]
    if state["n_missions"] >= total and not quiet:
        n = state["n_missions"]
        done = f"all {n} missions are" if n > 1 else "the one mission is"
        print(
            f"{done} done; for more, give --iterations. Figures and report are drawn again.",
            flush=True,
        )
    result = go_on(
        folder,
        simulator=_simulator(folder, state["notes"]),
        n_iterations=iterations,
        stop=stop,
        progress=not quiet,
    )
    write_outputs(result, folder, table=not quiet)


def _require_flags(iterations: int, seed: int, **names: str) -> None:
    """Refuse unknown names and numbers out of range (TrustboError) before heavy imports."""
    for flag, name in names.items():
        require_choice("sight mode" if flag == "sight" else flag, name, choices_of(flag))
    require_whole("n_iterations", iterations, 1)
    require_whole("seed", seed, 0)


def _require_sampler(model: "TrustModel", sampler: str) -> None:
    """Refuse a sampler that the model does not have (TrustboError) before a raster is read."""
    from trustbo.inference.samplers.choice import resolve_sampler

    resolve_sampler(model, sampler)


def _model(name: str, observation: str) -> "TrustModel":
    from trustbo.study.methods import MODELS, model_of

    return model_of(MODELS[name] | {"observation": observation})


def _require_same(file: Path, example: Path) -> None:
    """Refuse to replace a raster of the user: TrustboError."""
    from trustbo.files import read_file

    if file.exists() and read_file(file) != example.read_bytes():
        raise TrustboError(
            f"{str(file)!r} is not that of the demo, and would be replaced; give another --out."
        )


def _state(folder: Path) -> dict[str, Any]:
    """Read the state of a campaign from its folder."""
    from trustbo.campaign.folder import STATE
    from trustbo.files import interpreting, read_record

    if not (folder / STATE).exists():
        raise TrustboError(f"{str(folder)!r} holds no campaign; give the --out of trustbo run.")
    state = read_record(folder / STATE)
    with interpreting(folder / STATE):
        name = state["notes"].get("simulator")
    if name != "KinematicSimulator":
        raise TrustboError(
            f"the campaign in {str(folder)!r} was run by {name or 'robots of your own'}, not by "
            "trustbo run; go on with it in Python: trustbo.resume(folder, simulator=...), or, of "
            "ask and tell, trustbo.Campaign.load(folder)."
        )
    with interpreting(folder / STATE):
        state["n_missions"] = int(state["n_missions"])
        state["notes"]["n_iterations"] = int(state["notes"]["n_iterations"])
    return state


def _simulator(folder: Path, notes: dict[str, Any]) -> "KinematicSimulator":
    """Make the simulator that the campaign was begun with."""
    from trustbo.campaign.folder import STATE
    from trustbo.campaign.storage import read_workspace
    from trustbo.files import interpreting
    from trustbo.simulation import KinematicSimulator
    from trustbo.workspace import Sight

    workspace = read_workspace(folder)
    with interpreting(folder / STATE):
        sight = Sight(notes["sight"], notes["extinction"], notes["crown_base"])
        return KinematicSimulator(workspace, sight=sight, tick=notes["tick"])
