"""Summary of a result in sentences."""

import numpy as np

from trustbo.campaign.result import Result
from trustbo.data import path_text
from trustbo.display import joined
from trustbo.errors import TrustboError
from trustbo.hazard.risk import PathRisk
from trustbo.inference import memory
from trustbo.inference.samplers.convergence import GOOD_KHAT, MAX_KHAT, MAX_RHAT, MIN_ESS
from trustbo.planning import Plan
from trustbo.report.blocks import Fact
from trustbo.report.numbers import counted, number

_MEANS = {
    "lost_contact": "minus the contact expected to be lost on the way, in bounds",
    "terminal": "the chance \N{GREEK SMALL LETTER SIGMA}(trust) at the goal, 1 minus the paper's "
    "cost (6)",
    "mean": "the mean of expected trust over the bounds",
    "success": "the product of \N{GREEK SMALL LETTER SIGMA}(trust) over the bounds",
    "bottleneck": "the least expected trust on the way",
    "stationary": "the product of \N{GREEK SMALL LETTER SIGMA}(trust) over the bounds, trust taken "
    "as settled in each cell",
}


_TOLLS = {"length_weight": "its length", "unseen_cost": "the time in which nobody sees anybody"}


def facts_of(result: Result) -> list[Fact]:
    """Return the facts of the summary: campaign, recommendation, value, diagnostics, memory."""
    plan = result.plan
    return [
        Fact("The campaign", f"{_where(result)} {_missions(result)}"),
        Fact("Recommended", _path(result, plan)),
        Fact("Value", f"{_value(result)} {_exactness(plan)}", plan.exact or None),
        *([] if plan.risk is None else [Fact("Arrival", _arrival(plan.risk))]),
        _soundness(result),
        _memory(result),
        Fact("Why it ended", _end(result)),
    ]


def _where(result: Result) -> str:
    grid, team = result.workspace.grid, result.workspace.team
    rows, cols = grid.shape
    size = f"{number(cols * grid.cell_width, 0)} m \N{MULTIPLICATION SIGN} "
    size += f"{number(rows * grid.cell_height, 0)} m"
    cells = f"{rows} \N{MULTIPLICATION SIGN} {cols} cells"
    return (
        f"{counted(len(result.missions), 'mission')} on {cells}, {size}, with a lead and "
        f"{counted(len(team.names), 'robot')} ({joined(list(team.names))}) in overwatch."
    )


def _missions(result: Result) -> str:
    status = [str(s) for s in result.history["status"].values if s != "ok"]
    if not status:
        return "All reached the goal."
    kinds = joined(sorted(set(status)))
    return f"{len(status)} of them did not reach the goal ({kinds.replace('_', ' ')})."


def _path(result: Result, plan: Plan) -> str:
    revisits = f", entering {counted(plan.revisits, 'cell')} again" if plan.revisits else ""
    return (
        f"From cell {path_text(plan.path[:1])} (row, column) to {path_text(plan.path[-1:])} in "
        f"{counted(len(plan.path) - 1, 'bound')}, {number(plan.length, 0)} m{revisits}: "
        f"{path_text(plan.path).replace(' ', ' \N{RIGHTWARDS ARROW} ')}."
    )


def _value(result: Result) -> str:
    name = str(result.settings["objective"])
    meaning = _MEANS[name]
    if paid := [toll for name, toll in _TOLLS.items() if result.settings["planner"].get(name)]:
        meaning += f", less the toll on {joined(paid)}"
    within = ""
    if (band := result.plan.value_band) is not None:
        within = f" ({number(band[0])} to {number(band[1])} in 90 % of the draws)"
    return f"{number(result.value)}{within}, {meaning} (objective {name})."


def _exactness(plan: Plan) -> str:
    if plan.infeasible:
        return "No path that was found keeps within max_failure: it is of the safest."
    if plan.exact:
        return "It is exact: under the posterior mean, no admissible path is better."
    if np.isfinite(plan.bound):
        return f"It is not proven best: a path may be worth up to {number(plan.bound)}."
    return "Exactness was not checked: another path may be better."


def _arrival(risk: PathRisk) -> str:
    worst = int(np.argmax(risk.p_fail))
    sentence = (
        f"It reaches the goal with probability {risk.p_arrive:.3f}; its "
        f"bound {worst + 1} is the likeliest to fail, with {number(risk.p_fail[worst])}."
    )
    causes = {cause: float(p.sum()) for cause, p in risk.by_cause.items()}
    likeliest = [c for c, p in causes.items() if p >= (1.0 - 1e-6) * max(causes.values())]
    if len(likeliest) == 1:
        sentence += f" The likeliest cause is {likeliest[0].replace('_', ' ')}."
    return sentence


def _soundness(result: Result) -> Fact:
    """Judge the worst diagnostics over the posteriors of all missions."""
    history, sentences, good = result.history, [], True
    if "r_hat" in history:
        rhat = float(np.nanmax(history["r_hat"]))
        ess = float(np.nanmin(history["ess_bulk"]))
        divergences = int(np.nansum(history["divergences"]))
        good = rhat <= MAX_RHAT and ess >= MIN_ESS and divergences == 0
        sentences.append(
            f"R-hat is {number(rhat, 3)} at worst (good: at most {MAX_RHAT}), bulk ESS "
            f"{number(ess, 0)} at least (good: {MIN_ESS:.0f} or more), with "
            f"{counted(divergences, 'divergence')} (good: 0)"
        )
    if "k_hat" in history:
        khat, kish = (float(f(history[n])) for f, n in ((np.nanmax, "k_hat"), (np.nanmin, "kish")))
        good = good and khat <= MAX_KHAT
        sentences.append(
            f"the exact sampler's k-hat is {number(khat, 2)} at worst (good: below {GOOD_KHAT}; "
            f"usable: up to {MAX_KHAT}), its Kish size {number(kish, 0)} effective points at "
            "least; these are the evidence, as R-hat and ESS of resampled draws are always good"
        )
    if not sentences:
        return Fact("Posteriors", "Nothing could be learned yet.")
    verdict = "They are well sampled" if good else "Do not rely on them"
    return Fact("Posteriors", f"{verdict}: {'; '.join(sentences)}.", good)


def _memory(result: Result) -> Fact:
    """State whether trust carries over between bounds, or why this was not weighed."""
    try:
        finding = str(memory(result.posterior, result.missions, result.workspace))
    except TrustboError as error:
        return Fact("Memory", f"Not weighed: {error}")
    return Fact("Memory", f"{finding[0].upper()}{finding[1:]}.")


def _end(result: Result) -> str:
    """Return the reason of the end, or the command to resume."""
    text = result.stop_reason
    if text == "n_iterations":
        return "All missions asked for were run."
    if text == "interrupted":
        if result.settings.get("simulator") == "KinematicSimulator":  # as `trustbo run` has it
            return "It was interrupted, or is still under way: trustbo resume goes on."
        return "It is under way, or was interrupted: Campaign.load(folder) goes on."
    name, _, rest = text.partition(":")
    reasons = {
        "regret_bound": "The recommended path is good enough:",
        "seconds": "The time was up, in seconds:",
    }
    return f"{reasons[name]}{rest}." if name in reasons else f"A rule to stop said: {text}."
