"""The names of the product are the field's words; docs/reference/glossary.md defines each once."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
FILES = sorted(file for top in ("anatomy", "stages", "lungaccess") for file in (ROOT / top).rglob("*.py"))
STANDARD = {
    "climb, climbs, climber": "local search",
    "kick, kicks, kicked": "perturbation",
    "polish, polished": "intensification",
    "race, races, racing, heat, heats, led": "successive halving, rung, guided",
    "dear, dearer, dearest, price, prices, priced, pricing": "cost, costly, evaluate",
    "desk, court, judge, judges, judged, judgement": "evaluator, validator, the check",
    "stand, stands": "scope pose",
    "menu, menus, apart": "diverse plan set, separation",
    "hope, hopes, hopeful, hopeless": "reachability pruning, futile",
    "objection, objections": "violation",
    "scatter, scattered": "local sampling",
    "remedies": "counterfactuals",
    "told, course, courses": "instructions, device curve",
    "ways": "guide paths, subtree",
    "vet, vets, vetted, blind": "a plain word",
}
"""Words that name nothing here, and what the field says instead."""
WORDS = {word: said for words, said in STANDARD.items() for word in words.split(", ")}
PARTS = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|[0-9]+")


def names_of(file: Path) -> Iterator[str]:
    """Yield the names of a module, its classes, functions and their parameters."""
    yield from file.relative_to(ROOT).with_suffix("").parts
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            yield node.name
        elif isinstance(node, ast.arg):
            yield node.arg


def private_words(name: str) -> list[str]:
    """Return the words of a name that the field does not use."""
    return [part.lower() for part in PARTS.findall(name) if part.lower() in WORDS]


def test_names_are_the_fields_words() -> None:
    found = {
        f"{file.relative_to(ROOT)}: {name}": [f"{word}: {WORDS[word]}" for word in words]
        for file in FILES
        for name in names_of(file)
        if (words := private_words(name))
    }
    assert not found


def test_a_private_word_is_seen() -> None:
    assert private_words("ClimbOfDesk") == ["climb", "desk"]
    assert private_words("settled_priceless") == []
