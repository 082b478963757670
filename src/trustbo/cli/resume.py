"""`trustbo resume`: go on with a campaign that was interrupted, or is to be longer."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from trustbo.cli.errors import one_line_errors
from trustbo.cli.outputs import require_outputs, write_outputs
from trustbo.errors import TrustboError, require_whole

if TYPE_CHECKING:
    from trustbo.simulation import KinematicSimulator


def resume(
    folder: Path,
    iterations: int | None = None,
    stop_regret: float | None = None,
    quiet: bool = False,
    debug: bool = False,
) -> None:
    """Go on with a campaign that was interrupted, or with more missions.

    Example: trustbo resume out/demo
    More missions, 12 in all: trustbo resume out/demo --iterations 12

    The result is the same as without the interruption. The folder keeps all flags.
    A campaign that --stop-regret has ended goes on with more --iterations only.
    """
    with one_line_errors(debug, campaign=folder):
        if iterations is not None:
            require_whole("n_iterations", iterations, 1)
        state = _state(folder)
        require_outputs(folder, overwrite=True)
        from trustbo.campaign.loop import resume as go_on
        from trustbo.campaign.stopping import RegretBound

        stop = None if stop_regret is None else RegretBound(eps=stop_regret)
        total = iterations or state["notes"]["n_iterations"]
        if state["n_missions"] >= total and not quiet:
            print(f"all {state['n_missions']} missions are done; for more, give --iterations.")
        result = go_on(
            folder,
            simulator=_simulator(folder, state["notes"]),
            n_iterations=iterations,
            stop=stop,
            progress=not quiet,
        )
        write_outputs(result, folder, table=not quiet)


def _state(folder: Path) -> dict[str, Any]:
    """Read the state of a campaign from its folder."""
    if not (folder / "campaign.json").exists():
        raise TrustboError(f"{str(folder)!r} holds no campaign; give the --out of trustbo run.")
    from trustbo.campaign.damage import naming_what_is_left
    from trustbo.campaign.folder import read_state

    with naming_what_is_left(folder):
        state = read_state(folder)
    name = state["notes"].get("simulator")
    if name != "KinematicSimulator":
        raise TrustboError(
            f"the campaign in {str(folder)!r} was run by {name or 'robots of your own'}, not by "
            "trustbo run; go on with it in Python: trustbo.resume(folder, simulator=...)."
        )
    return state


def _simulator(folder: Path, notes: dict[str, Any]) -> "KinematicSimulator":
    """Make the simulator that the campaign was begun with."""
    from trustbo.logs.netcdf import read_tree
    from trustbo.simulation import KinematicSimulator
    from trustbo.workspace import Sight
    from trustbo.workspace import netcdf as archive

    workspace = archive.workspace_from_tree(read_tree(folder / "workspace.nc"))
    sight = Sight(notes["sight"], notes["extinction"], notes["crown_base"])
    return KinematicSimulator(
        workspace, sight=sight, tick=notes["tick"], bounding=notes["bounding"]
    )
