"""`trustbo live`: a campaign in the field, with a page."""

import sys
from pathlib import Path

from trustbo.errors import TrustboError


def live(
    folder: Path,
    port: int = 8737,
    listen: str = "127.0.0.1",
    udp: int | None = None,
    stdin: bool = False,
    bag: Path | None = None,
    rate: float = 1.0,
    foxglove: int | None = None,
    keep_path: bool = False,
) -> None:
    """Follow a campaign in the field: contact tick by tick, a page, a plan for each next bound.

    Example: trustbo live out/field --udp 8738
    A bag, ten times as fast: trustbo live out/field --bag log.bag --rate 10

    The page shows the map, the trust of each robot and what to do next, and has
    buttons for the outcome of each bound. Messages are lines of JSON, such as
    {"contact": {"r1": true, "r2": false}}; see docs/live.md. Nobody else reaches it
    without --listen and the token that is printed. After Ctrl-C, a crash or a power
    cut, the same command goes on where it was. TRUSTBO_TOKEN sets a token of yours.
    """
    from trustbo.campaign.replacing import STATE, current

    if not (current(folder) / STATE).exists():
        raise TrustboError(
            f"{str(folder)!r} holds no campaign; make one in Python by "
            "trustbo.Campaign(workspace, start, goal, directory=folder), or give the --out of "
            "trustbo run."
        )
    from trustbo.live import serve

    serve(
        folder, port=port, listen=listen, udp=udp, lines=sys.stdin.buffer if stdin else None,
        bag=bag, rate=rate, foxglove=foxglove, replan=not keep_path,
        ready=lambda text: print(text, flush=True),
    )  # fmt: skip
    print(f"stopped; trustbo live {folder} goes on.")
