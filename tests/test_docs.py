"""The examples of README and docs run as printed; what is public is listed."""

import re
from pathlib import Path

import pytest

import trustbo

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
EXAMPLES = [
    pytest.param(code, id=f"{page.name}-{i}")
    for page in PAGES
    for i, code in enumerate(re.findall(r"```python\n(.*?)```", page.read_text(), flags=re.S))
]


@pytest.mark.parametrize("code", EXAMPLES)
def test_examples_run_as_printed(code, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "example", "exec"), {})


def test_readme_and_api_have_examples():
    assert len(EXAMPLES) >= 2


@pytest.mark.parametrize("package", ["", "terrain", "models", "planning", "simulation"])
def test_every_public_name_is_on_the_api_page(package):
    page = (ROOT / "docs" / "api.md").read_text()
    module = getattr(trustbo, package) if package else trustbo
    missing = [name for name in module.__all__ if not re.search(rf"\b{name}\b", page)]
    assert missing == []


def test_links_and_figures_of_the_readme_exist():
    text = (ROOT / "README.md").read_text()
    for target in re.findall(r"\]\(((?!http)[^)]+)\)", text):
        assert (ROOT / target).exists(), target
