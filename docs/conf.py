"""Settings of the site that `make docs` builds; the build and the pages need no network."""

import argparse
import shutil
import sys
from importlib.metadata import version as installed_version
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE / "extensions"))

from api_pages import contents  # noqa: E402

RETURNED = ("trustbo.Plan", "trustbo.Result")
"""Classes whose objects are returned by functions; how to construct them is not documented."""

project = "trustbo"
author = "The trustbo developers"
project_copyright = f"2026, {author}"
version = release = installed_version("trustbo")

extensions = [
    "api_pages",
    "gallery",
    "mathml",
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
]
exclude_patterns = ["_build", "extensions", "generated/gallery", "generated/index", "paper"]
templates_path = ["_templates"]

# Pages are Markdown. Notebooks are stored with their outputs and not executed here.
myst_enable_extensions = ["attrs_inline", "colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3
nb_execution_mode = "off"
nb_merge_streams = True
suppress_warnings = [
    "mystnb.unknown_mime_type",  # widgets, which have a plain form beside
    "ref.ref", "ref.term",  # in docstrings inherited from scikit-learn
]  # fmt: skip

# Google docstrings. `Attributes:` is a list, so that no field is described twice.
napoleon_numpy_docstring = False
napoleon_custom_sections = [("Attributes", "params_style")]
napoleon_use_rtype = False
default_role = "code"  # docstrings quote names in single backticks
autosummary_imported_members = True
autosummary_ignore_module_all = False
autosummary_context = {"contents": contents(), "returned": RETURNED}
autosummary_filename_map = {  # some file systems do not distinguish it from trustbo.workspace
    "trustbo.Workspace": "trustbo.Workspace-class",
}
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
autoclass_content = "both"  # arguments of a class are often documented by `__init__`
add_module_names = False
python_maximum_signature_line_length = 120
python_display_short_literal_types = True

html_theme = "furo"
html_title = f"trustbo {version}"
html_math_renderer = "mathml"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sphinx = False
pygments_style = "friendly"
pygments_dark_style = "github-dark"
copybutton_prompt_text = r"\$ "
copybutton_prompt_is_regexp = True

_ARRAY_LIKE = (
    "~jax.Array | ~numpy.ndarray | ~numpy.bool | ~numpy.number | bool | int | float | complex"
)


def copy_notebooks(app: Sphinx) -> None:
    """Copy the notebooks into the folder of the docs, as Sphinx reads nothing outside it."""
    target = HERE / "notebooks"
    shutil.rmtree(target, ignore_errors=True)
    target.mkdir()
    for notebook in sorted((HERE.parent / "notebooks").glob("*.ipynb")):
        shutil.copy2(notebook, target)


def write_help(app: Sphinx) -> None:
    """Write the help of all commands to a file that the page of the command line includes."""
    from trustbo.cli import parser

    top = parser()
    commands = next(a for a in top._actions if isinstance(a, argparse._SubParsersAction))
    texts = [one.format_help() for one in (top, *commands.choices.values())]
    (HERE / "generated").mkdir(exist_ok=True)
    (HERE / "generated" / "cli.txt").write_text("\n\n".join(texts))


def point_to_copies(app: Sphinx, docname: str, source: list[str]) -> None:
    """Let links to notebooks, which are written for the repository, point to the copies."""
    source[0] = source[0].replace("../notebooks/", "notebooks/").replace("../docs/", "../")


def drop_words_of_python(
    app: Sphinx, kind: str, name: str, value: object, options: Any, lines: list[str]
) -> None:
    """Drop Python's own docstrings of a constant's type and of named tuples."""
    if kind == "data":
        lines.clear()
    lines[:] = [line for line in lines if not line.startswith("Create new instance of")]


def shorten_signature(
    app: Sphinx,
    kind: str,
    name: str,
    value: object,
    options: Any,
    signature: str | None,
    result: str,
) -> tuple[str | None, str]:
    """Write JAX's type of arrays by its name, and hide factories, which Sphinx cannot parse.

    The classes in `RETURNED` are shown without a signature.
    """
    if name in RETURNED:
        return "", result
    if signature is not None:
        signature = signature.replace(_ARRAY_LIKE, "~jax.typing.ArrayLike")
        signature = signature.replace("<factory>", "...")
    return signature, result


def skip_parts_of_models(
    app: Sphinx, kind: str, name: str, value: object, skip: bool, options: Any
) -> bool | None:
    """Leave out the members by which models implement `TrustModel`, which is not public."""
    if (value.__doc__ or "").startswith("See `TrustModel."):
        return True
    return None  # as usual


def setup(app: Sphinx) -> None:
    """Connect the functions above to Sphinx's events."""
    app.connect("builder-inited", copy_notebooks)
    app.connect("builder-inited", write_help)
    app.connect("source-read", point_to_copies)
    app.connect("autodoc-process-docstring", drop_words_of_python)
    app.connect("autodoc-process-signature", shorten_signature)
    app.connect("autodoc-skip-member", skip_parts_of_models)
