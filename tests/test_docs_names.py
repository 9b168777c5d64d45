"""What the pages name exists: modules, functions, files, studies; and every page is listed."""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = sorted(
    [
        *(ROOT / "docs").rglob("*.md"),
        ROOT / "README.md",
        ROOT / "CONTRIBUTING.md",
        *(ROOT / "examples").glob("*.py"),
    ]
)
PACKAGES = "anatomy|stages|lungaccess|experiments|benchmarks|tests"
NAME = re.compile(rf"^(?:{PACKAGES})(?:\.\w+)+")
NOT_A_NAME = ("anatomy.seg.nrrd", "experiments.NAME")
"""A file, and a place holder."""
FILE = re.compile(rf"^(?:{PACKAGES}|docs|results|examples)/[\w./-]+$")
TEST = re.compile(r"^(tests/[\w./-]+\.py)::(\w+)$")
IN_TICKS = re.compile(r"`([^`\n]+)`")
IMPORT = re.compile(rf"^from ((?:{PACKAGES})[\w.]*) import (?:\(([^)]*)\)|(.+)$)", re.MULTILINE)
STUDY = re.compile(r"python -m (experiments\.[a-z]\w+)")


@cache
def definitions(file: Path) -> dict[str, set[str]]:
    """Return the names that a module defines or imports, each with its members if it is a class."""
    names: dict[str, set[str]] = {}
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ClassDef):
            inside = list(ast.walk(node))
            members = {each.name for each in inside if isinstance(each, ast.FunctionDef)}
            members |= {each.id for each in inside if isinstance(each, ast.Name)}
            members |= {each.attr for each in inside if isinstance(each, ast.Attribute)}
            names[node.name] = members
        elif isinstance(node, ast.FunctionDef):
            names.setdefault(node.name, set())
        elif isinstance(node, ast.ImportFrom):
            names.update((alias.asname or alias.name, set()) for alias in node.names)
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names.update((each.id, set()) for each in targets if isinstance(each, ast.Name))
    return names


def exists(dotted: str) -> bool:
    """Tell whether a dotted name is a package, a module, or something that a module or its class defines."""
    parts = dotted.split(".")
    for count in range(len(parts), 0, -1):
        place = ROOT.joinpath(*parts[:count])
        file = place.with_suffix(".py") if place.with_suffix(".py").is_file() else place / "__init__.py"
        if not file.is_file():
            continue
        rest = parts[count:]
        stub = file.with_suffix(".pyi")
        known = definitions(stub if stub.is_file() else file)
        if len(rest) < 2:
            return not rest or rest[0] in known
        return rest[0] in known and (not known[rest[0]] or rest[1] in known[rest[0]])
    return False


def named(text: str) -> list[str]:
    """Return the dotted names of a page: in ticks, in imports, and of studies that it tells one to run."""
    ticks = [each for each in IN_TICKS.findall(text) if not each.endswith(NOT_A_NAME)]
    ticked = [match[0] for each in ticks if (match := NAME.match(each))]
    imported = [
        f"{module}.{name.split(' as ')[0].strip()}"
        for module, many, few in IMPORT.findall(text)
        for name in (many or few).split(",")
        if name.strip()
    ]
    return [*ticked, *imported, *STUDY.findall(text)]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_name_on_the_page_exists(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    missing = [name for name in named(text) if not exists(name)]
    missing += [each for each in IN_TICKS.findall(text) if FILE.match(each) and not (ROOT / each).exists()]
    assert not missing


def paper_rows() -> list[list[str]]:
    """Return the cells of every row of the tables of papers: place, implementation, test, study, result."""
    lines = (ROOT / "docs" / "reference" / "papers.md").read_text(encoding="utf-8").splitlines()
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("|")]
    return [row for row in rows if row[0] not in ("paper", "---")]


def test_each_place_of_a_paper_has_an_implementation_that_exists() -> None:
    for place, implementation, *_rest in paper_rows():
        names = IN_TICKS.findall(implementation)
        assert names and all(NAME.match(name) and exists(name) for name in names), place


def test_each_test_and_study_of_a_paper_exists() -> None:
    results = (ROOT / "results" / "tables.md").read_text(encoding="utf-8")
    for place, _implementation, test, study, result in paper_rows():
        for name in IN_TICKS.findall(test):
            match = TEST.match(name)
            file = ROOT / (match[1] if match else name)
            assert file.is_file() and (not match or match[2] in definitions(file)), (place, name)
        assert not study or exists(study.strip("`")), (place, study)
        if result:
            section = results.split(f"`{study.split('.')[-1]}\n", 1)[-1].split("\n### ", 1)[0]
            rows = [line for line in section.splitlines() if line.startswith("|")]
            assert any(result in row for row in rows), (place, result)


def test_the_index_lists_every_page() -> None:
    index = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    docs = ROOT / "docs"
    pages = {page.relative_to(docs).with_suffix("").as_posix() for page in docs.rglob("*.md")} - {"index"}
    assert not [page for page in pages if f"({page}.md)" not in index]
    assert not [page for page in pages if not re.search(rf"^{page}$", index, re.MULTILINE)]


def test_a_wrong_name_is_seen() -> None:
    assert exists("lungaccess.plans.plan.Plan.to_json") and exists("stages.needle.Query")
    assert not exists("lungaccess.plans.plan.Plann") and not exists("lungaccess.nowhere")
