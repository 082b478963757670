"""Gallery of figures: draws each figure of `trustbo.plots` and takes one from each notebook.

The pictures and the text `figures.md`, which the page `gallery.md` includes, are written to
`generated/gallery` when the site is built. They are drawn again only if the source of the figures
has changed.
"""

import base64
import hashlib
import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from sphinx.application import Sphinx

HERE = Path(__file__).resolve().parents[1]
FOLDER = HERE / "generated" / "gallery"
EXPLORER = "explore.html"
_DPI = 110
_NOTEBOOKS = (
    "Jupyter notebooks with their outputs; `make jupyter` installs JupyterLab and opens copies."
)
_PICTURES = {
    "1_quickstart": 1,
    "2_paper_experiment": 2,
    "3_paper_parameters": 3,
    "4_own_model": 3,
    "5_compare_models": 4,
}
"""Index of the stored picture of a notebook that is shown; by default, the first one."""
_START, _GOAL = (7, 0), (0, 5)
_SCRUB = (2, 1)
"""Cell in the middle of scrub that has grown since the survey, on the first path."""


class Figure(NamedTuple):
    """A figure of the gallery."""

    name: str
    """Full name of the function or method that draws it."""
    draw: Callable[[], Any]
    caption: str
    wide: bool = False
    """Whether the figure has panels side by side, which need the width of the page."""


def figures() -> Iterator[Figure]:
    """Run a small campaign with a poor robot and an outdated map, and yield figures of it."""
    import arviz as az

    import trustbo as tb

    terrain = tb.terrain.example()
    workspace = tb.Workspace.from_terrain(terrain, shape=(8, 6))
    damage = tb.simulation.Degradation("r2", detection=0.6)
    scrub = tb.simulation.Trees(3.0, workspace.grid.center(_SCRUB), 40.0)
    simulator = tb.simulation.KinematicSimulator(workspace, events=[damage, scrub])
    result = tb.iterate(
        workspace, _START, _GOAL, n_iterations=6, planner={"failure_cost": 9.0},
        simulator=simulator, progress=False,
    )  # fmt: skip
    plots = tb.plots
    robots = tb.check(result.posteriors).robots
    maps = result.history, result.trust_map, result.path
    sd = result.maps()["trust_sd"]
    size = {"figsize": (5.2, 3.4)}

    def forest() -> Any:
        weights = ["beta0", "beta", "b"]
        return az.plot_forest(result.posterior, var_names=weights, figure_kwargs=size)

    def predictions() -> Any:
        return az.plot_ppc_dist(result.posterior, num_samples=50, figure_kwargs=size)

    yield Figure(
        "trustbo.plots.terrain_maps", lambda: plots.terrain_maps(workspace),
        "Height of the surface, and the three features of awareness. Line of sight is averaged "
        "over moves and robots. Grey cells are impassable.",
        wide=True,
    )  # fmt: skip
    yield Figure(
        "trustbo.plots.trust_maps",
        lambda: plots.trust_maps(*maps, workspace, missions=(1, 2)),
        "Trust maps before mission 1, and after missions 1 and 6, with the next path. The first "
        "path leads through scrub that is not on the map; the later ones lead around it.",
        wide=True,
    )
    yield Figure(
        "trustbo.plots.trust_curves", lambda: plots.trust_curves(result.posterior),
        "Trust in each robot along the last mission; the lidar of r2 is damaged. The bands are for "
        "trust, not for single contact rates, so dots may lie outside the bands.",
        wide=True,
    )  # fmt: skip
    yield Figure(
        "trustbo.Result.plot_history", lambda: result.plot_history(),
        "Contact lost in each mission, measured and predicted by the plan. The first plan does "
        "not know of the scrub and of the damage; later predictions agree, but in mission 5, "
        "which tries new bounds.",
    )  # fmt: skip
    yield Figure(
        "trustbo.plots.plan_map", lambda: plots.plan_map(result.plan(), bounds=[1, 2]),
        "The path with its overwatch points, and routes and sight lines of two bounds.", wide=True,
    )  # fmt: skip
    yield Figure(
        "trustbo.plots.ways_map", lambda: plots.ways_map(result.ways()),
        "Ways from start to goal: contact lost, probability of arrival and length. No other path "
        "is better in all three.",
    )  # fmt: skip
    yield Figure(
        "trustbo.plots.robot_effects", lambda: plots.robot_effects(robots),
        "Effect of each robot in each mission, with bars of two standard deviations; some are "
        "shorter than the markers. Effects in the grey band hardly change a plan. Filled markers "
        "show that r2 stands out from the team: it loses contact in all missions.",
    )  # fmt: skip
    yield Figure(
        "trustbo.plots.cell_map", lambda: plots.cell_map(sd, workspace, path=result.path),
        "Any map of cells, here the standard deviation of trust.",
    )  # fmt: skip
    yield Figure(
        "trustbo.plots.grid_map", lambda: plots.grid_map(workspace),
        "The planning cells with their rows and columns. Grey cells are impassable.",
    )  # fmt: skip
    yield Figure(
        "arviz.plot_forest", forest,
        "Posterior of memory, weights and intercept: means and intervals.",
    )  # fmt: skip
    yield Figure(
        "arviz.plot_ppc_dist", predictions,
        "Posterior predictive check: measured contact rates (black) and predicted ones. The "
        "default Gaussian family fails this check: 36 % of the measured rates are 1, of its "
        "predictions 20 % are 1 or more, and predictions exceed 1. The mean, the spread and the "
        "smallest rate agree. Plans need the mean of trust only. To predict single rates, use the "
        'family "censored" with the same effects, which predicts that 38 % are 1.',
    )  # fmt: skip
    yield Figure(
        "trustbo.plots.explore",
        lambda: plots.explore(result.plan(), result.maps(), result.history), "",
    )  # fmt: skip


def write_gallery(app: Sphinx) -> None:
    """Draw the figures, if their source has changed, and write the text of the page."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    stamp = FOLDER / "source.txt"
    source = _source()
    if not stamp.exists() or stamp.read_text() != source:
        draw_figures()
        stamp.write_text(source)

    drawn = json.loads((FOLDER / "figures.json").read_text())
    paths = sorted((HERE.parent / "notebooks").glob("*.ipynb"))
    notebooks = [_notebook(path) for path in paths]
    text = ["````{container} gallery", *(_figure(*entry) for entry in drawn), "````"]
    text += ["", "## Notebooks", "", _NOTEBOOKS, ""]
    text += ["````{container} gallery", *notebooks, "````", ""]
    new = "\n".join(text)
    page = FOLDER / "figures.md"
    if not page.exists() or page.read_text() != new:
        page.write_text(new)


def draw_figures() -> None:
    """Save a picture of each figure, and the page of the explorer."""
    import trustbo as tb

    saved = []
    with mpl.rc_context({"backend": "agg"}):
        for name, draw, caption, wide in figures():
            drawn = draw()
            if name == "trustbo.plots.explore":
                drawn.save(FOLDER / EXPLORER)
                continue

            saved.append((name, caption, wide))
            is_arviz = name.startswith("arviz.")
            figure = drawn.viz["figure"].item() if is_arviz else np.ravel(drawn)[0].figure
            figure.savefig(FOLDER / f"{name}.png", dpi=_DPI)
            mpl.pyplot.close(figure)

    missing = {f"trustbo.plots.{name}" for name in tb.plots.__all__} - {row[0] for row in saved}
    if missing != {"trustbo.plots.explore"}:
        raise ValueError(f"docs/extensions/gallery.py does not draw {sorted(missing)}")
    (FOLDER / "figures.json").write_text(json.dumps(saved))


def _source() -> str:
    """Return a hash of this file and of the modules that draw."""
    import trustbo as tb

    files = [Path(__file__), *sorted(Path(tb.plots.__file__).parent.glob("*.py"))]
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()


def _figure(name: str, caption: str, wide: bool) -> str:
    """Return the text of a figure, which links to the page of its function."""
    if name.startswith("arviz."):
        short = name.replace("arviz.", "az.")
        link = f"{{doc}}`{short} <howto/use-arviz>`"
        target = "howto/use-arviz.html"
    else:
        role = "func" if name.startswith("trustbo.plots") else "meth"
        page = name if role == "func" else name.rpartition(".")[0]
        target = f"generated/{page}.html" + ("" if role == "func" else f"#{name}")
        short = name.removeprefix("trustbo.")
        link = f"{{py:{role}}}`{short} <{name}>`"
    return _entry(f"{name}.png", caption, target, f"{link}: {caption}", wide=wide)


def _notebook(path: Path) -> str:
    """Save a picture stored in a notebook; return its text, which links to the notebook."""
    notebook = json.loads(path.read_text())
    title = "".join(notebook["cells"][0]["source"]).splitlines()[0].removeprefix("# ")
    outputs = [output for cell in notebook["cells"] for output in cell.get("outputs", [])]
    pictures = [o["data"]["image/png"] for o in outputs if "image/png" in o.get("data", {})]
    shown = pictures[_PICTURES.get(path.stem, 0)]
    (FOLDER / f"{path.stem}.png").write_bytes(base64.b64decode(shown))

    page = f"notebooks/{path.stem}"
    return _entry(f"{path.stem}.png", f"Figure of {title}", f"{page}.html", f"{{doc}}`{page}`")


def _entry(picture: str, alt: str, target: str, caption: str, *, wide: bool = False) -> str:
    """Return a figure in MyST, whose picture is a link."""
    path = f"generated/gallery/{picture}"
    options = f":alt: {alt}\n:target: {target}"
    if wide:
        options += "\n:figclass: wide"
    return f"```{{figure}} {path}\n{options}\n\n{caption}\n```"


def copy_explorer(app: Sphinx, error: Exception | None) -> None:
    """Copy the page of the explorer into the site."""
    if error is None and app.builder.format == "html":
        shutil.copy2(FOLDER / EXPLORER, Path(app.outdir) / "_static" / EXPLORER)


def setup(app: Sphinx) -> dict[str, bool]:
    """Write the gallery before pages are read, and copy the explorer after they are written."""
    app.connect("builder-inited", write_gallery)
    app.connect("build-finished", copy_explorer)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
