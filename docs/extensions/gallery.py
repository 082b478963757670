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
from typing import Any

import matplotlib as mpl
import numpy as np
from sphinx.application import Sphinx

HERE = Path(__file__).resolve().parents[1]
FOLDER = HERE / "generated" / "gallery"
EXPLORER = "explore.html"
_DPI = 110
_NOTEBOOKS = (
    "Jupyter notebooks with their outputs; `make jupyter` installs JupyterLab and opens them."
)
_START, _GOAL = (7, 0), (0, 3)


def figures() -> Iterator[tuple[str, Callable[[], Any]]]:
    """Run a small campaign on the terrain of the package, and yield a drawing of each figure."""
    import trustbo as tb

    terrain = tb.terrain.example()
    workspace = tb.Workspace.from_terrain(terrain, shape=(8, 6))
    result = tb.iterate(
        workspace, _START, _GOAL, n_iterations=4, planner={"failure_cost": 9.0}, progress=False
    )
    plots = tb.plots
    robots = tb.check(result.posteriors).robots
    maps = result.history, result.trust_map, result.path

    yield "trustbo.plots.terrain_maps", lambda: plots.terrain_maps(workspace)
    yield "trustbo.plots.trust_maps", lambda: plots.trust_maps(*maps, workspace, missions=(1, 2))
    yield "trustbo.plots.plan_map", lambda: plots.plan_map(result.plan, bounds=[1, 2])
    yield "trustbo.plots.trust_curves", lambda: plots.trust_curves(result.posterior)
    yield "trustbo.Result.plot_history", lambda: result.plot_history()
    yield "trustbo.plots.robot_effects", lambda: plots.robot_effects(robots)
    sd = result.maps()["trust_sd"]
    yield "trustbo.plots.cell_map", lambda: plots.cell_map(sd, workspace, path=result.path)
    yield "trustbo.plots.grid_map", lambda: plots.grid_map(workspace)
    yield "trustbo.plots.explore", lambda: plots.explore(result.plan, result.maps(), result.history)


def write_gallery(app: Sphinx) -> None:
    """Draw the figures, if their source has changed, and write the text of the page."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    stamp = FOLDER / "source.txt"
    source = _source()
    if not stamp.exists() or stamp.read_text() != source:
        draw_figures()
        stamp.write_text(source)

    names = json.loads((FOLDER / "figures.json").read_text())
    notebooks = [_notebook(path) for path in sorted((HERE.parent / "notebooks").glob("*.ipynb"))]
    text = ["````{container} gallery", *(_figure(name) for name in names), "````"]
    text += ["", "## Notebooks", "", _NOTEBOOKS, ""]
    text += ["````{container} gallery", *notebooks, "````", ""]
    new = "\n".join(text)
    page = FOLDER / "figures.md"
    if not page.exists() or page.read_text() != new:
        page.write_text(new)


def draw_figures() -> None:
    """Save a picture of each figure, and the page of the explorer."""
    import trustbo as tb

    names = []
    with mpl.rc_context({"backend": "agg"}):
        for name, draw in figures():
            drawn = draw()
            if name == "trustbo.plots.explore":
                drawn.save(FOLDER / EXPLORER)
                continue

            names.append(name)
            figure = np.ravel(drawn)[0].figure
            figure.savefig(FOLDER / f"{name}.png", dpi=_DPI)
            mpl.pyplot.close(figure)

    missing = {f"trustbo.plots.{name}" for name in tb.plots.__all__} - {*names}
    if missing != {"trustbo.plots.explore"}:
        raise ValueError(f"docs/extensions/gallery.py does not draw {sorted(missing)}")
    (FOLDER / "figures.json").write_text(json.dumps(names))


def _source() -> str:
    """Return a hash of this file and of the modules that draw."""
    import trustbo as tb

    files = [Path(__file__), *sorted(Path(tb.plots.__file__).parent.glob("*.py"))]
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()


def _figure(name: str) -> str:
    """Return the text of a figure, which links to the page of its function."""
    role = "func" if name.startswith("trustbo.plots") else "meth"
    page = name if role == "func" else name.rpartition(".")[0]
    target = f"generated/{page}.html" + ("" if role == "func" else f"#{name}")
    short = name.removeprefix("trustbo.")
    return _entry(f"{name}.png", f"Figure of {short}", target, f"{{py:{role}}}`{short} <{name}>`")


def _notebook(path: Path) -> str:
    """Save the first picture stored in a notebook; return its text, which links to the notebook."""
    notebook = json.loads(path.read_text())
    title = "".join(notebook["cells"][0]["source"]).splitlines()[0].removeprefix("# ")
    outputs = [output for cell in notebook["cells"] for output in cell.get("outputs", [])]
    pictures = [o["data"]["image/png"] for o in outputs if "image/png" in o.get("data", {})]
    (FOLDER / f"{path.stem}.png").write_bytes(base64.b64decode(pictures[0]))

    page = f"notebooks/{path.stem}"
    return _entry(
        f"{path.stem}.png", f"First figure of {title}", f"{page}.html", f"{{doc}}`{page}`"
    )


def _entry(picture: str, alt: str, target: str, caption: str) -> str:
    """Return a figure in MyST, whose picture and caption are links."""
    path = f"generated/gallery/{picture}"
    return f"```{{figure}} {path}\n:alt: {alt}\n:target: {target}\n\n{caption}\n```"


def copy_explorer(app: Sphinx, error: Exception | None) -> None:
    """Copy the page of the explorer into the site."""
    if error is None and app.builder.format == "html":
        shutil.copy2(FOLDER / EXPLORER, Path(app.outdir) / "_static" / EXPLORER)


def setup(app: Sphinx) -> dict[str, bool]:
    """Write the gallery before pages are read, and copy the explorer after they are written."""
    app.connect("builder-inited", write_gallery)
    app.connect("build-finished", copy_explorer)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
