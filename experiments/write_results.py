"""Make RESULTS.md and the full tables from the result files of the studies.

    python -m experiments.write_results [--results FOLDER] [--out RESULTS.md]

RESULTS.md is one page: the headline rows of each study.  FOLDER/tables.md has every row: one section a paper,
then our own studies, then machines and versions.  The full setting is shown where it was run, with the quick
one beside it.  The same files give the same bytes.
"""

from __future__ import annotations

import argparse
import json
import os
from itertools import groupby
from pathlib import Path
from typing import Any

from anatomy.base.errors import FileError
from anatomy.base.files import atomic_write, read_text
from experiments.support.headlines import HEADLINES, MEASURED_ON
from experiments.support.results import Row, cells, number

PAPERS = {
    "Rosell et al. 2012": ("rosell2012",),
    "Fu et al. 2018": ("fu2018_cost_map", "fu2018_needle"),
    "Kuntz et al. 2015": ("kuntz2015_reachability", "kuntz2015_quality"),
    "Li et al. 2021": ("li2021_route",),
    "Pan et al. 2025": ("pan2025_tour",),
    "Alterovitz et al. 2008": ("alterovitz2008",),
}
OUR_OWN = (
    "reachability_by_device",
    "coverage_by_device",
    "decided_targets",
    "tube_designs",
    "needle_planners",
    "tube_speed",
    "closed_loop",
    "procedures",
    "success_planning",
    "rare_events",
    "lobes",
    "slice_thickness",
    "growth",
    "breathing",
    "phantom_likeness",
)
SETTINGS = ("full", "quick")
OUR_TITLE = "Our own studies"
TABLES = "tables.md"
HEADLINES_HEAD = """# Results

The headline rows of every study.  [All rows]({tables}), with conditions, seeds and what was not reproduced,
are one page further.  "Ratio" is ours divided by the paper's.  The data are named below each full table: two
segmented lungs, two CTs and synthetic patients, and the numbers promise nothing for others.
[How they are made]({how}).  Made by `python -m experiments.write_results`; do not edit.
"""
TABLES_HEAD = """# Results: all rows

Made by `python -m experiments.write_results` from the files beside this page; do not edit.  The headline rows
stand on [one page]({headlines}).  "Ratio" is ours divided by the paper's, of the full setting where there is
one.  What was not reproduced is said below each table, with the reason.
"""

Found = dict[str, dict[str, Any]]


def read_all(folder: Path) -> dict[str, Found]:
    """Return the stored results by name and setting.

    Raises:
        FileError: If a file is damaged.
    """
    found: dict[str, Found] = {}
    for setting in SETTINGS:
        for file in sorted((folder / setting).glob("*.json")):
            found.setdefault(file.stem, {})[setting] = _read(file)
    return found


def _read(file: Path) -> dict[str, Any]:
    try:
        stored: dict[str, Any] = json.loads(read_text(file))
        stored["rows"] = [Row(**row) for row in stored["rows"]]
        _ = stored["title"], stored["conditions"], stored["machine"]["libraries"]
    except (ValueError, TypeError, KeyError) as error:
        raise FileError(
            f"{file} is damaged: {error!r}",
            expected="a result as experiments.support.results.write_result stores it",
            remedy=f"Run `python -m experiments.{file.stem}` again",
        ) from error
    return stored


def headlines(found: dict[str, Found], tables: str, docs: str) -> str:
    """Return the text of RESULTS.md.

    Args:
        found: Results by name and setting, see `read_all`.
        tables, docs: The page of all rows and the folder of the documentation, as links from RESULTS.md name
            them.
    """
    how = f"{docs}/measurements/results.md"
    lines = [HEADLINES_HEAD.format(tables=tables, how=how).rstrip("\n"), ""]
    head = ["study", "quantity", "paper", "ours", "ratio", "setting"]
    lines += [_line(head), _line(["---"] * len(head))]
    for name in _names(found):
        lines += [_line([f"[`{name}`]({tables}#{name})", *each]) for each in _headlines(name, found, docs)]
    return "\n".join(lines) + "\n"


def _headlines(name: str, found: dict[str, Found], docs: str) -> list[list[str]]:
    """Return the cells of a study's headline rows, or one that says why there is none."""
    made = found.get(name, {})
    page = MEASURED_ON.get(name)
    elsewhere = f"measured once: [page]({docs}{page.removeprefix('docs')})" if page else ""
    if not made:
        return [["; ".join(filter(None, ("**no result is kept**", elsewhere))), "", "", "", "none"]]
    shown = made.get("full") or made["quick"]
    state = shown.get("progress") or ""
    state = f"{shown['setting']}, **unfinished: {state}**" if state else shown["setting"]
    state = f"{state}; more was {elsewhere}" if elsewhere and "full" not in made else state
    by_quantity = {row.quantity: row for row in shown["rows"]}
    rows = [by_quantity[each] for each in HEADLINES.get(name, ()) if each in by_quantity]
    rows = rows or shown["rows"][:1]
    return [[*cells(row)[:4], state] for row in rows]


def page(found: dict[str, Found], headlines: str) -> str:
    """Return the text of the page of all rows, which lies in the folder of the results.

    Args:
        found: Results by name and setting, see `read_all`.
        headlines: RESULTS.md, as a link from this page names it.
    """
    parts = [TABLES_HEAD.format(headlines=headlines), _overview(found)]
    for paper, names in PAPERS.items():
        parts.append(f"## {paper}\n")
        parts += [section(name, found.get(name, {})) for name in names]
    parts.append(f"## {OUR_TITLE}\n")
    known = [name for names in PAPERS.values() for name in names]
    parts += [section(name, found.get(name, {})) for name in _names(found) if name not in known]
    parts.append(_machines(found))
    return "\n".join(parts)


def _names(found: dict[str, Found]) -> list[str]:
    """Return the names of all studies in the order of the pages, with those that only have a result last."""
    known = [*(name for names in PAPERS.values() for name in names), *OUR_OWN]
    return [*known, *sorted(set(found) - set(known))]


def section(name: str, found: Found) -> str:
    """Return the section of one study; it says so where a setting has no result."""
    anchor = f'<a id="{name}"></a>\n\n'
    if not found:
        lacking = f"**No result.**  `python -m experiments.{name}` was not run, or failed.\n"
        return f"{anchor}### `{name}`\n\n{lacking}"
    shown = found.get("full") or found["quick"]
    lines = [f"{anchor}### {shown['title']}: `{name}`\n", _state(found) + "\n"]
    if shown["source"]:
        lines.append(f"Compared with: {shown['source']}.\n")
    lines += _table(found) + [""]
    lines += [f"- {key}: {words}" for key, words in shown["conditions"].items()]
    lines.append(f"- seeds: {ranges(shown['seeds'])}\n")
    if shown["not_reproduced"]:
        lines += ["Not reproduced:\n", *[f"- {words}" for words in shown["not_reproduced"]], ""]
    if shown.get("figure"):
        lines.append(f"![{shown['title']}]({shown['setting']}/{shown['figure']})\n")
    return "\n".join(lines)


def ranges(seeds: list[int]) -> str:
    """Return whole numbers with runs of them written as ranges.

    Examples:
        >>> ranges([1, 2, 3, 7])
        '1 to 3, 7'
    """
    out = []
    for _, group in groupby(enumerate(sorted(seeds)), key=lambda pair: pair[1] - pair[0]):
        run = [seed for _, seed in group]
        out.append(str(run[0]) if len(run) == 1 else f"{run[0]} to {run[-1]}")
    return ", ".join(out) or "none"


def _state(found: Found) -> str:
    words = []
    for setting in SETTINGS:
        made = found.get(setting)
        if made is None:
            words.append(f"{setting} setting: **not run, or failed**")
        else:
            spent = f"{number(made['cpu_s'])} s of CPU, {number(made['wall_s'])} s by the clock"
            left = f"**unfinished: {made['progress']}**" if made.get("progress") else ""
            words.append(f"{setting} setting: {left or spent}")
    text = "; ".join(words)
    return text[0].upper() + text[1:] + "."


def _table(found: Found) -> list[str]:
    """Return the lines of a table; a setting that was run has a column, the paper only if it has a number."""
    shown = found.get("full") or found["quick"]
    both = len(found) == 2
    quick = {row.quantity: row for row in found["quick"]["rows"]} if both else {}
    compared = any(row.paper is not None for made in found.values() for row in made["rows"])
    settings = [f"ours, {setting}" for setting in SETTINGS if setting in found]
    head = ["quantity", *_if(compared, "paper"), *settings, *_if(compared, "ratio"), "note"]
    lines = [_line(head), _line(["---"] * len(head))]
    for row in shown["rows"]:
        quantity, paper, ours, ratio, note = cells(row)
        values = [ours, *_if(both, _ours(quick.pop(row.quantity, None)))]
        lines.append(_line([quantity, *_if(compared, paper), *values, *_if(compared, ratio), note]))
    for row in quick.values():
        quantity, paper, ours, _, note = cells(row)
        lines.append(_line([quantity, *_if(compared, paper), "", ours, *_if(compared, ""), note]))
    return lines


def _if(wanted: bool, words: str) -> list[str]:
    return [words] if wanted else []


def _ours(row: Row | None) -> str:
    return "" if row is None else number(row.ours)


def _line(columns: list[str]) -> str:
    return "| " + " | ".join(each.replace("|", "\\|") for each in columns) + " |"


def _overview(found: dict[str, Found]) -> str:
    """Return which studies were run in which setting."""
    lines = ["| study | full | quick |", "| --- | --- | --- |"]
    for name in _names(found):
        marks = [_mark(found.get(name, {}).get(setting)) for setting in SETTINGS]
        lines.append(f"| `{name}` | {' | '.join(marks)} |")
    return "\n".join(lines) + "\n"


def _mark(made: dict[str, Any] | None) -> str:
    if made is None:
        return "**missing**"
    return f"**unfinished: {made['progress']}**" if made.get("progress") else "yes"


def _machines(found: dict[str, Found]) -> str:
    """Return which machine and versions the results come from."""
    groups: dict[str, list[str]] = {}
    for name in sorted(found):
        for setting, made in found[name].items():
            groups.setdefault(_machine(made["machine"]), []).append(f"{name} ({setting})")
    lines = ["## Machines and versions\n"]
    for machine, studies in groups.items():
        which = "all" if len(groups) == 1 else ", ".join(studies)
        lines.append(f"- {machine}.  Studies: {which}")
    return "\n".join(lines) + "\n"


def _machine(machine: dict[str, Any]) -> str:
    libraries = ", ".join(f"{name} {version}" for name, version in machine["libraries"].items())
    return (
        f"{machine['processor']}, {machine['cores']} cores, {number(machine['memory_gib'])} GiB, "
        f"{machine['system']}, Python {machine['python']}; {libraries}"
    )


def write_page(results: Path, out: Path) -> None:
    """Read the results of a folder and write the page of all rows there, and RESULTS.md, each in one step."""
    found, tables = read_all(results), results / TABLES
    pages = {tables: page(found, _link(out, tables)), out: headlines(found, _link(tables, out), "docs")}
    for file, text in pages.items():
        with atomic_write(file) as temporary:
            temporary.write_text(text, encoding="utf-8")


def _link(to: Path, page: Path) -> str:
    return Path(os.path.relpath(to, page.parent)).as_posix()


def main() -> None:
    """Write both pages."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--results", type=Path, default=Path("results"), metavar="FOLDER")
    parser.add_argument("--out", type=Path, default=Path("RESULTS.md"))
    options = parser.parse_args()
    write_page(options.results, options.out)


if __name__ == "__main__":
    main()
