"""Interactive page: one HTML file with Bokeh's library in it, which a notebook shows in a frame."""

import html
import json
from dataclasses import dataclass, field

import jinja2

from trustbo.files import FilePath, require_file, write_text
from trustbo.models.backend import VERSIONS
from trustbo.plots.explorer import canvas
from trustbo.plots.explorer.scene import Scene

_SYMBOLS = {
    "circle": "\N{BLACK CIRCLE}", "square": "\N{BLACK SQUARE}", "diamond": "\N{BLACK DIAMOND}",
    "triangle": "\N{BLACK UP-POINTING TRIANGLE}", "star": "\N{BLACK STAR}", "plus": "+",
    "inverted_triangle": "\N{BLACK DOWN-POINTING TRIANGLE}", "x": "\N{MULTIPLICATION SIGN}",
}  # fmt: skip


@dataclass(frozen=True)
class Explorer:
    """Interactive page of a campaign; the last expression of a notebook's cell shows it.

    Attributes:
        title: Heading of the page.
        html: The page. It needs no network and no other file.
    """

    title: str
    html: str = field(repr=False)

    def save(self, path: FilePath) -> None:
        """Write the page as an HTML file.

        Raises:
            TrustboError: The file cannot be written, or its name does not end in .html.
        """
        write_text(require_file(path, ".html", ".htm"), self.html)

    def _repr_html_(self) -> str:
        """Page in a separate frame, so that its style and script do not affect the notebook."""
        return (
            f'<iframe title="{html.escape(self.title)}" srcdoc="{html.escape(self.html)}" '
            'style="width:100%;height:820px;border:0" loading="lazy"></iframe>'
        )


def draw_explorer(scene: Scene) -> Explorer:
    """Draw the interactive page of a scene."""
    from bokeh.embed import json_item
    from bokeh.resources import Resources

    record = scene.record()
    colours = {layer["colours"] for layer in record["layers"]}
    marks = canvas.robot_marks(len(record["robots"]))
    record["palettes"] = {name: canvas.palette(name) for name in sorted(colours)}
    record["marks"] = [list(mark) for mark in marks]
    groups: dict[str, list[tuple[int, str]]] = {}
    for i, layer in enumerate(record["layers"]):
        groups.setdefault(layer["group"], []).append((i, layer["label"]))
    figures = {"map": canvas.draw_map(scene), "chart": canvas.draw_chart(scene)}
    page = page_of("trustbo.plots.explorer").render(
        title=scene.title,
        groups=groups,
        n_steps=len(scene.steps),
        robots=[
            (name, _SYMBOLS[marker], colour)
            for name, (marker, colour) in zip(record["robots"], marks, strict=True)
        ],
        has_posts=any(step.posts is not None for step in scene.steps),
        has_overwatch=any(step.overwatch is not None for step in scene.steps),
        has_closed=not bool(scene.workspace.passable.all()),
        left_out=record["left_out"],
        library=Resources(mode="inline", components=["bokeh"], log_level="error").render_js(),
        scene=_script(record),
        figures={name: _script(json_item(figure)) for name, figure in figures.items()},
        version=VERSIONS["trustbo"],
    )
    return Explorer(scene.title, page)


def page_of(package: str) -> jinja2.Template:
    """Template `page.html` of a package."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader(package, "."),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template("page.html")


def _script(record: object) -> str:
    """JSON that cannot end the script element it stands in."""
    return json.dumps(record, separators=(",", ":")).replace("<", "\\u003c")
