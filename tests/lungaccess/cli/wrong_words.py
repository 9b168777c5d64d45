"""Command lines that are wrong in one way each, drawn from what the commands really take."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args, get_origin

from cyclopts import App
from hypothesis import strategies as st

from lungaccess.cli.app import app
from lungaccess.cli.examples import EXAMPLES
from lungaccess.cli.numbers import Within

WRITES = {"--out", "--slicer", "--movie", "--page", "--csv", "--parquet"}
"""Options whose path is written."""
POINTS = {("segment", "--target"), ("segment", "--seed"), ("route", "--goal"), ("route", "--start")}
SYSTEMS = {"--system", "--show", "--compare"}
LISTS = ("", "no such thing", ",", "rrt,nonsense", "50,x", "nan")
"""No lists of planners or radii."""
ANYTHING = {"--name", "--series", "--scheduler", "--cache"}
"""Options of which no text is wrong by itself, or whose fault another machine finds."""
BAD_POINTS = (
    "", "1,2,3", "xyz:1,2,3", "ras:1,2", "ras:1,2,3,4", "lps:a,b,c", "lps:nan,0,0", "lps:0,0,inf", "ras:",
    "ras 1 2 3", "lps:1;2;3", "lps:\N{GREEK SMALL LETTER ALPHA},0,0", "RAS=1,2,3",
)  # fmt: skip
FAR_POINTS = ("lps:1e9,0,0", "ras:0,0,-5000", "lps:-9e307,1e308,0")
"""Points in no patient."""
NO_NUMBERS = (
    "x", "", "nan", "1,5", "--", "1e", "0x", "\N{INFINITY}", "one", "1 2", "5mm", "30 deg", "10%",
    "1e999", "--5", "1__0", "\N{VULGAR FRACTION ONE HALF}", "1,000.0", "-nan", "null", "true",
)  # fmt: skip
ODD_WORDS = (
    "",
    "no such thing",
    "\N{SNOWMAN}\N{CJK UNIFIED IDEOGRAPH-80BA}",
    "[bold]x[/]",
    "a" * 300,
    "\udcff",
    "..",
)


@dataclass(frozen=True)
class World:
    """Files that a wrong command line may name; see `make_world`."""

    folder: Path
    bad_inputs: tuple[str, ...]
    bad_systems: tuple[str, ...]
    bad_outputs: tuple[str, ...]
    foreign_plan: str


def command_of(name: str) -> App:
    """Return the command with a name such as "study run"."""
    found = app
    for part in name.split():
        found = found[part]
    return found


def arguments_of(name: str) -> list[Any]:
    """Return what a command takes, as cyclopts sees it."""
    return [
        each for each in command_of(name).assemble_argument_collection() if each.name != "*" and each.parse
    ]


def right_words(name: str) -> list[str]:
    """Return words that a command accepts, in the folder of `make_world`; those of its example."""
    return shlex.split(EXAMPLES[name])[1:]


def with_option(words: list[str], option: str, value: str) -> list[str]:
    """Return words with a value of an option replaced, or the option added."""
    kept = list(words)
    if option in kept:
        place = kept.index(option)
        del kept[place : place + (1 if option == "--nodule" else 2)]
    return [*kept, f"{option}={value}"]


def kind_of(argument: Any) -> Any:
    """Return the type of an argument, without None."""
    kinds = [kind for kind in get_args(argument.hint) or () if kind is not type(None)]
    if get_origin(argument.hint) is not None and len(kinds) == 1:
        return kinds[0]
    return argument.hint


def ranges_of(argument: Any) -> list[Within]:
    """Return the ranges that a number has to keep."""
    return [each for each in argument.parameter.validator or () if isinstance(each, Within)]


def outside(limits: Within) -> Iterator[str]:
    """Return finite numbers outside a range, infinity, and one that is too small for anything."""
    yield from ("inf", "5e-324")
    if limits.above is not None:
        yield from (f"{limits.above:.10g}", f"{limits.above - 1:.10g}")
    if limits.at_least is not None:
        yield from (f"{limits.at_least - 1:.10g}", "-9" + "9" * 30)
    if limits.below is not None:
        yield f"{limits.below:.10g}"
    if limits.at_most is not None:
        yield from (f"{limits.at_most + 1:.10g}", "9" * 40)


def bad_values(name: str, argument: Any, world: World) -> tuple[str, ...]:
    """Return values that an argument of a command cannot have."""
    kind, option = kind_of(argument), argument.name
    if option in ANYTHING or kind is bool:
        return ()
    if kind in (int, float):
        found = [*NO_NUMBERS, *(each for limits in ranges_of(argument) for each in outside(limits))]
        if kind is int:
            found += ["1.5", "1e3"]
        return tuple(found + (["0", "-1", "9999"] if option == "--nodule" else []))
    if option == "--folder":
        return tuple(file for file in world.bad_inputs if file)
    if option == "--errors":
        return (*ODD_WORDS, *(file for file in world.bad_inputs if file != "bad/empty.toml"))
    if kind is Path:
        return world.bad_outputs if option in WRITES else world.bad_inputs
    if (name, option) in POINTS:
        return BAD_POINTS
    if option == "--target":
        return (*BAD_POINTS, *FAR_POINTS)
    if option in SYSTEMS:
        return (*world.bad_systems, *(word for word in ODD_WORDS if option != "--compare" or word))
    if option in ("--planners", "--radius"):
        return LISTS
    if option == "--start":
        return ("0", "77", *world.bad_inputs)
    if option in ("--goal", "--objective"):
        return (*ODD_WORDS, "length=", "length=-1", "length=nan", "length=0", "=1", "length=1,,", "beauty=1")
    return ODD_WORDS


@st.composite
def wrong_words(draw: st.DrawFn, world: World) -> list[str]:
    """Draw a command line that is wrong in one way."""
    name = draw(st.sampled_from(sorted(EXAMPLES)))
    words, arguments = right_words(name), arguments_of(name)
    kinds = ["value"] * 8 + ["unknown option", "word too many", "no value", "command"]
    if any(each.required for each in arguments):
        kinds += ["missing"] * 2
    if any(each.name == "--nodule" for each in arguments):
        kinds += ["two targets"]
    if "plan/plan.json" in words and name not in ("needle", "check"):
        kinds += ["foreign plan"] * 2
    fault = draw(st.sampled_from(kinds))
    wrong = draw(_faults(fault, name, words, arguments, world))
    if "completion" not in wrong[:1] and "template" not in wrong[:1] and draw(st.booleans()):
        wrong = [*wrong, "--json"] if draw(st.booleans()) else ["--json", *wrong]
    return ["--quiet", *wrong] if draw(st.booleans()) else wrong


def _faults(
    fault: str, name: str, words: list[str], arguments: list[Any], world: World
) -> st.SearchStrategy[list[str]]:
    depth = len(name.split())
    if fault == "value":
        choices = [(each, bad_values(name, each, world)) for each in arguments]
        choices = [(each, values) for each, values in choices if values]
        if choices:
            return st.sampled_from(choices).flatmap(
                lambda choice: st.sampled_from(choice[1]).map(
                    lambda value: _with_value(words, depth, arguments, choice[0], value)
                )
            )
    if fault == "missing":
        return st.just(words[:depth])
    if fault == "no value":
        options = [
            each.name for each in arguments if kind_of(each) is not bool and each.name.startswith("--")
        ]
        options = [option for option in (*options, "--cache") if option not in ("--nodule", *words)]
        if options:
            return st.sampled_from(options).map(lambda option: [*words, option])
    if fault == "two targets":
        kept = with_option([word for word in words if word != "--nodule"], "--nodule", "1")
        return st.just(with_option(kept, "--target", "lps:0,0,0"))
    if fault == "foreign plan":
        return st.just([world.foreign_plan if word == "plan/plan.json" else word for word in words])
    if fault == "word too many":
        return st.sampled_from(("more", "\N{SNOWMAN}", "PATIENT")).map(
            lambda word: [*words, word, word, word]
        )
    if fault == "command":
        return st.sampled_from(ODD_WORDS[1:-1]).map(lambda word: [f"{word}x", *words[1:]])
    return st.sampled_from(("--nosuch", "--nosuch=1", "--Out", "-z", "--target.x=1")).map(
        lambda option: [*words, option]
    )


def _with_value(words: list[str], depth: int, arguments: list[Any], argument: Any, value: str) -> list[str]:
    """Return words with one value replaced, by name or, for folders and files, at its place."""
    places = [each.name for each in arguments if not each.field_info.is_keyword_only]
    if argument.name in places:
        place = depth + places.index(argument.name)
        return [*words[:place], value, *words[place + 1 :]]
    return with_option(words, argument.name, value)
