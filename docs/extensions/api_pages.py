"""Contents of the pages of the API: one page for each module, class and function, and an index.

The templates in `_templates/autosummary` list what `contents` finds. An object that several modules
offer has one page, under its shortest name. The page `api.md` includes the index of all names.
"""

import importlib
import inspect
import re
import sys
import types
from pathlib import Path

from sphinx.application import Sphinx
from sphinx.pycode import ModuleAnalyzer

HERE = Path(__file__).resolve().parents[1]
INDEX = HERE / "generated" / "index" / "names.md"


def listed_modules() -> list[str]:
    """Names of the modules that the page `api.md` lists, in order."""
    return re.findall(r"^ +(trustbo[\w.]*)$", (HERE / "api.md").read_text(), flags=re.M)


def contents() -> dict[str, dict[str, list]]:
    """Find the public names of all modules, by the kind of object.

    Returns:
        For each module, names of `modules`, `classes`, `exceptions` and `functions` with a page
        below that of the module, full names of objects with a page `elsewhere`, and `constants` as
        pairs of a name and the lines of its description.
    """
    names = listed_modules()
    pages = {}  # name of the page of each object
    found = {}
    for module in sorted(names, key=lambda name: name.count(".")):
        found[module] = contents_of(module, names, pages)
    return found


def contents_of(name: str, modules: list[str], pages: dict[int, str]) -> dict[str, list]:
    """Find the public names of one module, and add those with a page here to `pages`."""
    kinds = ("modules", "classes", "exceptions", "functions", "elsewhere", "constants")
    found = {kind: [] for kind in kinds}
    module = importlib.import_module(name)
    for short in module.__all__:
        value = getattr(module, short)
        full = f"{name}.{short}"
        kind = kind_of(value)
        if kind == "constants":
            found[kind].append((short, description_of(short, value)))
        elif kind == "modules":
            if full in modules and name != "trustbo":  # those of trustbo are in the table above
                found[kind].append(short)
        elif id(value) in pages:
            found["elsewhere"].append(pages[id(value)])
        else:
            pages[id(value)] = full
            found[kind].append(short)
    return found


def kind_of(value: object) -> str:
    """Return the key of `contents` for an object."""
    if isinstance(value, types.ModuleType):
        return "modules"
    if inspect.isclass(value):
        return "exceptions" if issubclass(value, Exception) else "classes"
    return "functions" if inspect.isfunction(value) else "constants"


def description_of(name: str, value: object) -> list[str]:
    """Lines of the string that follows a constant in the module that defines it."""
    for module in [m for m in sys.modules if m.startswith("trustbo.")]:
        if vars(sys.modules[module]).get(name) is value:
            docs = ModuleAnalyzer.for_module(module).find_attr_docs()
            if ("", name) in docs:
                return docs["", name]
    return []


def write_index(app: Sphinx) -> None:
    """Write a table of all public names of all modules, in alphabetical order."""
    rows = ["| name | module | description |", "|---|---|---|"]
    for name, module in sorted(all_names(), key=lambda found: (found[0].lower(), found)):
        text = summary_of(module, name).replace("|", "\\|")
        rows.append(f"| {{py:obj}}`{name} <{module}.{name}>` | `{module}` | {text} |")

    INDEX.parent.mkdir(parents=True, exist_ok=True)
    INDEX.write_text("\n".join(rows) + "\n")


def all_names() -> list[tuple[str, str]]:
    """Pairs of each public name and the module with its page, without modules."""
    kinds = ("classes", "exceptions", "functions")
    pairs = []
    for module, found in contents().items():
        pairs += [(name, module) for kind in kinds for name in found[kind]]
        pairs += [(name, module) for name, _ in found["constants"]]
    return pairs


def summary_of(module: str, name: str) -> str:
    """Return the first sentence of the description of a public name."""
    value = getattr(importlib.import_module(module), name)
    if kind_of(value) == "constants":
        lines = description_of(name, value)
    else:
        lines = (inspect.getdoc(value) or "").splitlines()

    paragraph = " ".join("\n".join(lines).strip().partition("\n\n")[0].split())
    return re.split(r"(?<=\.) (?=[A-Z])", paragraph)[0]


def remove_stale_pages(app: Sphinx) -> None:
    """Remove the pages of names that are not public any more, about which Sphinx would warn."""
    known = set(app.config.autosummary_filename_map.values())
    for module, found in app.config.autosummary_context["contents"].items():
        with_page = [*found["classes"], *found["exceptions"], *found["functions"]]
        known |= {module, *(f"{module}.{name}" for name in with_page)}
    for page in (HERE / "generated").glob("trustbo*.rst"):
        if page.stem not in known:
            page.unlink()


def setup(app: Sphinx) -> dict[str, bool]:
    """Write the index, and remove old pages after autosummary has written its own."""
    app.connect("builder-inited", write_index)
    app.connect("builder-inited", remove_stale_pages, priority=900)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
