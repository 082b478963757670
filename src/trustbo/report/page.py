"""Page of a result: one HTML file that needs no other."""

from collections.abc import Iterator, Sequence
from pathlib import Path

from trustbo.campaign.result import Result
from trustbo.criticism import criticise
from trustbo.errors import TrustboError
from trustbo.files import FilePath, require_file, write_text
from trustbo.models.backend import VERSIONS
from trustbo.plots.explorer.page import page_of
from trustbo.report import figures, tables
from trustbo.report.blocks import Fact, Section
from trustbo.report.numbers import counted
from trustbo.report.summary import facts_of


def write_report(path: FilePath, result: Result, *, title: str | None = None) -> list[Path]:
    """Write a result as one HTML page with its figures; equal results give equal bytes.

    The interactive page of `Result.explore` is written to the same folder, and linked to:
    `explore.html` for `report.html`, `north-explore.html` for `north.html`. It is a second file
    because Bokeh's library, 1.4 MB, would take the page beyond the 3 MB that it may have.

    Args:
        path: HTML file to write, or to replace; ends in .html or .htm.
        result: Result of a campaign.
        title: Title of the page; by default it has the number of missions.

    Returns:
        The two files written, the page first.

    Raises:
        TrustboError: The result has no mission, or the file cannot be written.
    """
    target = require_file(path, ".html", ".htm")
    if not result.missions:
        raise TrustboError("the result has no mission; run one first.")
    prefix = "" if target.name == "report.html" else f"{target.stem}-"
    explorer = require_file(target.with_name(f"{prefix}explore.html"))
    result.explore().save(explorer)
    name = title or f"The most trustworthy path after {counted(len(result.missions), 'mission')}"
    page = render(
        name,
        facts_of(result),
        list(_sections(result)),
        explorer=explorer.name,
        version=result.settings.get("trustbo_version", VERSIONS["trustbo"]),
    )
    write_text(target, page)
    return [target, explorer]


def render(
    title: str,
    facts: Sequence[Fact],
    sections: Sequence[Section],
    *,
    explorer: str | None = None,
    version: str = VERSIONS["trustbo"],
) -> str:
    """Fill the page.

    Args:
        title: Title.
        facts: Facts of the summary.
        sections: Sections below it.
        explorer: Name of the interactive page in the same folder; None without one.
        version: Version that made the result.
    """
    filled = {"facts": facts, "sections": sections, "explorer": explorer}
    return page_of("trustbo.report").render(title=title, version=version, **filled)


def _sections(result: Result) -> Iterator[Section]:
    """Yield the sections of the page, the most important first."""
    yield Section("maps", "Trust maps", "", [figures.trust_maps(result)])
    on_terrain = result.workspace.ground is not None
    orders = [figures.orders(result)] if on_terrain else []
    yield Section("path", "The recommended path", "", [tables.bounds_table(result), *orders])
    yield Section(
        "certainty",
        "Certainty of the path",
        "The recommended path is the best under the posterior mean; under single draws of the "
        "posterior, others may be.",
        [figures.path_posterior(result)],
    )
    if "places" in result.posterior.children:
        yield Section(
            "places",
            "Places",
            "Where contact is better or worse than the terrain says, and how sure we are.",
            [figures.places(result)],
        )
    if result.planner.problem.risk is not None:
        yield Section(
            "hazard",
            "Failures",
            "Where robots are likely to fail, as the terrain and the missions so far say.",
            [figures.hazard(result)],
        )
    yield Section("cost", "Cost per robot", "", [figures.robot_costs(result)])
    if on_terrain:
        yield Section("terrain", "Terrain", "", [figures.terrain(result)])
    parameters = figures.parameters(result)
    learned = [*([] if parameters is None else [parameters]), tables.parameter_table(result)]
    yield Section("learned", "Parameters", _meaning_of_parameters(result), learned)
    yield _criticism(result)
    last = [figures.last_mission(result)]
    yield Section("last", "Trust along the last mission", _last_outcome(result), last)
    history = [figures.history(result), tables.history_table(result)]
    yield Section("history", "The campaign", "", history)
    yield Section("settings", "Settings", "", [tables.settings_table(result)])


def _criticism(result: Result) -> Section:
    """Section of the model's criticism, or of the reason why there is none."""
    try:
        outcome = criticise(result.posterior, result.missions, compare=False)
    except TrustboError as error:
        return Section("criticism", "Criticism of the model", f"Not made: {error}", [])
    sentence = outcome.verdict[0].upper() + outcome.verdict[1:]
    blocks = [figures.criticism(outcome), tables.criticism_table(outcome)]
    return Section("criticism", "Criticism of the model", sentence, blocks)


def _meaning_of_parameters(result: Result) -> str:
    itself, awareness = ("B0", "B") if "B0" in result.posterior["posterior"] else ("beta0", "beta")
    return (
        f"The parameters of the model, {result.settings['model']}: trust follows itself by "
        f"{itself}, and the awareness of the bound by {awareness}."
    )


def _last_outcome(result: Result) -> str:
    mission = result.missions[-1]
    n, status = len(mission.bounds), mission.status
    if status == "ok":
        return f"It reached the goal in {counted(n, 'bound')}."
    return f"It ended as {status.replace('_', ' ')!r} in bound {n}, short of the goal."
