"""The code that a command runs, and a digest of its content.

The closure of a command are the functions of this repository that its processes call, and the
modules that they import. Its content are the syntax trees of these functions, and of the statements
of these modules and their classes outside functions, such as constants. Comments, docstrings,
imports and functions that are not called do not count. Functions that numba compiles are not seen
when they are called, so those of all imported modules count.

A closure is stored as text, with a line for each file: its path, and the names of the functions.
"""

import ast
import functools
import hashlib
import os
import subprocess
import sys
import tempfile
from collections import defaultdict
from collections.abc import Iterable, Mapping
from pathlib import Path

FOLDERS = ("src", "benchmarks", "scripts", "tests")
"""Folders whose code counts."""
_COMPILED = ("kernel", "part", "njit", "register_jitable")
"""Parts of the names of decorators of functions that numba compiles."""
_LOCALS = ".<locals>"

Closure = Mapping[str, frozenset[str]]
"""Names of the functions that are called, by file."""


def run_traced(root: Path, command: str) -> Closure:
    """Run a shell command in `root`; return its closure. Exits if the command fails."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "closure")
        paths = [str(root / "scripts" / "traced"), os.environ.get("PYTHONPATH", "")]
        own = {
            "TRUSTBO_CLOSURE": str(file),
            "TRUSTBO_ROOT": str(root),
            "PYTHONPATH": os.pathsep.join(path for path in paths if path),
            "PATH": os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]]),
        }
        done = subprocess.run(command, shell=True, cwd=root, env=os.environ | own, check=False)
        if done.returncode != 0:
            sys.exit(f"the command failed, and nothing is recorded: {command}")
        return closure_of(file.read_text().splitlines())


def closure_of(lines: Iterable[str]) -> Closure:
    """Return the closure of lines `FILE::NAME`; functions in functions are parts of the outer."""
    found: defaultdict[str, set[str]] = defaultdict(set)
    for line in lines:
        file, _, name = line.partition("::")
        if file.split("/")[0] in FOLDERS:
            found[file].add(name.partition(_LOCALS)[0])
    return {file: frozenset(names) for file, names in sorted(found.items())}


def joined(one: Closure, other: Closure) -> Closure:
    """Return the functions of either closure."""
    files = sorted({*one, *other})
    return {file: one.get(file, frozenset()) | other.get(file, frozenset()) for file in files}


def read(file: Path) -> Closure:
    """Read a closure; it is empty if there is no file."""
    if not file.exists():
        return {}
    rows = [line.partition(": ") for line in file.read_text().splitlines()]
    return {name: frozenset(names.split()) for name, _, names in rows}


def write(file: Path, closure: Closure, root: Path) -> None:
    """Write a closure, without names that stand for no function, such as those of lambdas."""
    lines = []
    for name, called in closure.items():
        known = functions_of((root / name).read_text())
        lines.append(f"{name}: {' '.join(sorted(called & set(known)))}".rstrip())
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text("\n".join(lines) + "\n")


def contents(root: Path, closure: Closure) -> dict[str, str]:
    """Return the content of each function and module of a closure, by `FILE::NAME`.

    Files that are gone have none.
    """
    found = {}
    for file, called in closure.items():
        if not (root / file).exists():
            continue
        functions = functions_of((root / file).read_text())
        for name in ("", *called):
            if name in functions:
                found[f"{file}::{name}"] = functions[name]
    return found


def digest(root: Path, closure: Closure) -> str:
    """Return the digest of the content of a closure in the working tree."""
    found = contents(root, closure)
    text = "\n".join(f"{name}\n{found[name]}" for name in sorted(found))
    return hashlib.sha256(text.encode()).hexdigest()[:16]


@functools.cache
def functions_of(text: str) -> dict[str, str]:
    """Return the syntax tree of each function of a module by name, and of the rest as ""."""
    found: dict[str, str] = {}
    rest: list[str] = []
    _collect(ast.parse(text).body, "", found, rest)
    return {**found, "": "\n".join(rest)}


def _collect(body: list[ast.stmt], prefix: str, found: dict[str, str], rest: list[str]) -> None:
    """Sort the statements of a module or class into functions and others."""
    for node in body:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            decorators = [ast.dump(one) for one in node.decorator_list]
            if any(name in one for one in decorators for name in _COMPILED):
                rest.append(tree_of(node))
            else:  # of equal names, such as those of a property and its setter, all count
                name = prefix + node.name
                found[name] = found.get(name, "") + tree_of(node)
        elif isinstance(node, ast.ClassDef):
            head = [*node.bases, *node.keywords, *node.decorator_list]
            rest.append(f"class {node.name} {[ast.dump(one) for one in head]}")
            _collect(node.body, f"{prefix}{node.name}.", found, rest)
        elif not isinstance(node, ast.Import | ast.ImportFrom) and not is_text(node):
            rest.append(tree_of(node))


def tree_of(tree: ast.AST) -> str:
    """Return a syntax tree as text, without docstrings."""
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):  # also texts below constants and fields, which describe them
            node.body = [part for part in body if not is_text(part)]  # pyright: ignore
    return ast.dump(tree)


def is_text(node: ast.AST) -> bool:
    """Return whether a statement is a text alone."""
    return (
        isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    )
