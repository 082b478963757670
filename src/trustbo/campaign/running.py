"""Missions of a campaign, run by a simulator."""

import logging
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from trustbo.campaign.state import LEARNED
from trustbo.campaign.stopping import Stop
from trustbo.data import Mission
from trustbo.display import compiling, progress_bar
from trustbo.planning import Plan
from trustbo.simulation import Truth
from trustbo.simulation.protocol import Simulator

if TYPE_CHECKING:
    from trustbo.campaign.campaign import Campaign

_log = logging.getLogger(__name__)


def run_missions(
    campaign: "Campaign",
    simulator: Simulator,
    n_iterations: int,
    truth: Truth | None,
    rules: Sequence[Stop],
    progress: bool,
) -> Iterator[tuple[Plan, Mission]]:
    """Run the missions of a campaign, see `Campaign.run`, which checks the arguments."""
    state, shown = campaign.state, campaign.progress
    state.stop_reason, campaign.progress = "interrupted", progress
    bar = progress_bar(progress, total=n_iterations, initial=len(state.entries), desc="missions")
    try:
        with bar, compiling():
            # The rules are asked before each mission: they may hold already when one continues.
            while not (reason := _reason_to_end(campaign, n_iterations, rules)):
                n, plan = len(state.entries), campaign.ask()
                mission = simulator.run(plan.path, seed=state.seed_of("mission"), mission=n)
                extra = {}
                if truth is not None:
                    longest = campaign.planner.max_bounds
                    extra["regret"] = truth.at(n).regret(plan.path, max_bounds=longest)
                campaign.tell(mission, **extra)
                line = _in_a_line(state.entries[-1].row)
                bar.set_postfix_str(line, refresh=False)
                bar.update()
                _log.info("mission %d: %s", n + 1, line)
                yield plan, mission
    finally:
        campaign.progress = shown
    campaign.stop(reason)


def _reason_to_end(campaign: "Campaign", n_iterations: int, rules: Sequence[Stop]) -> str | None:
    """Why no further mission is run: what the first rule says, by default its name; or None."""
    n = len(campaign.state.entries)
    for rule in rules if n else ():
        if verdict := rule(campaign):
            name = getattr(rule, "__name__", type(rule).__name__)
            return verdict if isinstance(verdict, str) else name
    return "n_iterations" if n >= n_iterations else None


def _in_a_line(row: dict[str, Any]) -> str:
    """Describe a mission in a line."""
    regret = f", regret {row['regret']:.1f} %" if "regret" in row else ""
    name, label = ("r_hat", "R-hat") if "r_hat" in row else ("k_hat", "k-hat")
    learned = f"{label} {row[name]:.3f}" if row["state"] == LEARNED else row["state"]
    return f"objective {row['objective']:.3f}{regret}, {learned}, {row['status']}"
