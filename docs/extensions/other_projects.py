"""Links from signatures to the pages of other projects, where the build has a network.

Inventories of names are fetched beforehand, so that a build without a network has no warning: it
has no such links.
"""

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from importlib import import_module
from pathlib import Path
from typing import Any
from urllib.request import urlopen

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.config import Config
from sphinx.ext import intersphinx

SECONDS = 5.0
"""Longest wait for one inventory."""


def fetch_inventories(projects: Mapping[str, str], folder: Path) -> dict[str, tuple[str, str]]:
    """Fetch the inventories of projects by the addresses of their pages, all at once.

    Returns:
        Address and fetched file of each project that could be reached.
    """

    def fetch(name: str) -> Path | None:
        file = folder / f"{name}.inv"
        try:
            with urlopen(f"{projects[name]}objects.inv", timeout=SECONDS) as response:
                content = response.read()
        except OSError:
            return None
        if not content.startswith(b"# Sphinx inventory"):  # a page to log in, for example
            return None
        file.write_bytes(content)
        return file

    folder.mkdir(parents=True, exist_ok=True)
    with ThreadPoolExecutor() as pool:
        files = dict(zip(projects, pool.map(fetch, projects), strict=True))
    return {name: (projects[name], str(file)) for name, file in files.items() if file is not None}


def public_name(name: str) -> str:
    """Shortest name of a thing: xarray.DataTree of xarray.core.datatree.DataTree."""
    module, _, last = name.rpartition(".")
    parts = module.split(".")
    try:
        thing = getattr(import_module(module), last)
    except (ImportError, AttributeError, ValueError):
        return name
    for n in range(1, len(parts)):
        package = ".".join(parts[:n])
        if getattr(import_module(package), last, None) is thing:
            return f"{package}.{last}"
    return name


def use_inventories(app: Sphinx, config: Config) -> None:
    """Give intersphinx the inventories that could be fetched."""
    config.intersphinx_mapping = fetch_inventories(
        config.other_projects, Path(app.doctreedir) / "inventories"
    )


def link_public_name(app: Sphinx, env: Any, node: Any, text: Any) -> nodes.reference | None:
    """Link a name that intersphinx does not find by its shortest form."""
    target = node.get("reftarget", "")
    if node.get("refdomain") != "py" or target.startswith("trustbo"):
        return None
    node["reftarget"] = public_name(target)
    return intersphinx.missing_reference(app, env, node, text)


def setup(app: Sphinx) -> dict[str, bool]:
    """Connect the above, before and after intersphinx."""
    app.setup_extension("sphinx.ext.intersphinx")
    app.add_config_value("other_projects", {}, "env")
    app.connect("config-inited", use_inventories, priority=100)
    app.connect("missing-reference", link_public_name, priority=900)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
