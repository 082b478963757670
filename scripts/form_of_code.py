"""Print the size and form of Python code: syntax nodes, blank lines, comments, longest functions.

    python scripts/form_of_code.py FOLDER [FOLDER ...]

Each folder is a package, such as src/trustbo, or the source of another library to compare it with.
Nodes are those of the abstract syntax tree, which packing code into fewer lines does not lower.
Blank lines and comments are shares of the lines of function bodies, without docstrings. Tuple
assignments give several values to as many names in one statement, as in `a, b = f(x), g(y)`, per
1000 lines of code. Compare these figures between libraries; they are no targets.
"""

import argparse
import ast
import io
import tokenize
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

Function = ast.FunctionDef | ast.AsyncFunctionDef


class Form(NamedTuple):
    """Figures of one package."""

    n_nodes: int
    n_functions: int
    n_files: int
    n_lines: int
    blank: float
    comments: float
    tuples: float
    longest: list[tuple[int, str]]


def main() -> None:
    """Print one row for each folder, and its longest functions."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--longest", type=int, default=3, help="longest functions to name")
    given = parser.parse_args()

    print(
        "| folder | nodes | functions | files | lines "
        "| blank in bodies | comments in bodies | tuples per 1000 | longest |"
    )
    print("|---|---:|---:|---:|---:|---:|---:|---:|---|")
    for folder in given.folders:
        form = form_of(folder)
        longest = ", ".join(f"{name} {n}" for n, name in form.longest[: given.longest])
        print(
            f"| {folder} | {form.n_nodes} | {form.n_functions} | {form.n_files} "
            f"| {form.n_lines} | {form.blank:.1%} | {form.comments:.1%} "
            f"| {form.tuples:.1f} | {longest} |"
        )


def form_of(folder: Path) -> Form:
    """Measure all Python files below a folder."""
    n_nodes = 0
    n_files = 0
    n_lines = 0
    n_body = 0
    n_blank = 0
    n_comments = 0
    n_tuples = 0
    longest: list[tuple[int, str]] = []

    for file in sorted(folder.rglob("*.py")):
        text = file.read_text(encoding="utf-8")
        tree = ast.parse(text)
        lines = text.splitlines()
        comments = lines_with_comments(text)
        n_nodes += sum(1 for _ in ast.walk(tree))
        n_files += 1
        n_lines += len(lines)
        n_tuples += sum(is_tuple_assignment(node) for node in ast.walk(tree))

        body = set()
        for function in functions_of(tree):
            of_function = lines_of_body(function)
            body |= of_function
            longest.append((len(of_function), function.name))
        n_body += len(body)
        n_blank += sum(not lines[i - 1].strip() for i in body)
        n_comments += len(comments & body)

    longest.sort(reverse=True)
    return Form(
        n_nodes=n_nodes,
        n_functions=len(longest),
        n_files=n_files,
        n_lines=n_lines,
        blank=n_blank / max(n_body, 1),
        comments=n_comments / max(n_body, 1),
        tuples=1000.0 * n_tuples / max(n_lines, 1),
        longest=longest,
    )


def functions_of(tree: ast.AST) -> Iterator[Function]:
    """Yield all functions and methods of a module."""
    for node in ast.walk(tree):
        if isinstance(node, Function):
            yield node


def lines_of_body(function: Function) -> set[int]:
    """Return the numbers of the lines of a function's body, without its docstring."""
    statements = function.body
    if ast.get_docstring(function, clean=False) is not None:
        statements = statements[1:]
    if not statements:
        return set()

    end = function.end_lineno or statements[-1].lineno
    return set(range(statements[0].lineno, end + 1))


def is_tuple_assignment(node: ast.AST) -> bool:
    """Return whether a node assigns a tuple of values to a tuple of names."""
    return (
        isinstance(node, ast.Assign)
        and isinstance(node.value, ast.Tuple)
        and any(isinstance(target, ast.Tuple) for target in node.targets)
    )


def lines_with_comments(text: str) -> set[int]:
    """Return the numbers of the lines that have a comment."""
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    return {token.start[0] for token in tokens if token.type == tokenize.COMMENT}


if __name__ == "__main__":
    main()
