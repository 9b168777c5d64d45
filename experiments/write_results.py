"""Make RESULTS.md from the result files of the studies.

    python -m experiments.write_results [--results FOLDER] [--out RESULTS.md]

One section a paper, then our own studies, then machines and versions.  The full setting is shown where it was
run, with the quick one beside it.  The same files give the same bytes.
"""

from __future__ import annotations

import argparse
import json
import os
from itertools import groupby
from pathlib import Path
from typing import Any

from anatomy.errors import FileError
from anatomy.io.files import atomic_write, read_text
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
)
SETTINGS = ("full", "quick")
OUR_TITLE = "Our own studies"
HEAD = """# Results

Made by `python -m experiments.write_results` from the files in `{folder}/`; do not edit.  `make results` runs
all studies in the full setting, and `make results-quick` in the quick one
([how](docs/measurements/results.md)).  "Ratio" is ours divided by the paper's, of the full setting where
there is one.  What was not reproduced is said below each table, with the reason.
"""

Found = dict[str, dict[str, Any]]


def read_all(folder: Path) -> dict[str, Found]:
    """Return the stored results by name and setting.

    Raises
    ------
    FileError
        If a file is damaged.
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


def page(found: dict[str, Found], folder: str) -> str:
    """Return the text of RESULTS.md.

    Parameters
    ----------
    found : dict
        Results by name and setting, see `read_all`.
    folder : str
        Where they are, as links from RESULTS.md name it.
    """
    parts = [HEAD.format(folder=folder), _overview(found)]
    for paper, names in PAPERS.items():
        parts.append(f"## {paper}\n")
        parts += [section(name, found.get(name, {}), folder) for name in names]
    parts.append(f"## {OUR_TITLE}\n")
    known = [name for names in PAPERS.values() for name in names]
    others = sorted(set(found) - set(known) - set(OUR_OWN))
    parts += [section(name, found.get(name, {}), folder) for name in (*OUR_OWN, *others)]
    parts.append(_machines(found))
    return "\n".join(parts)


def section(name: str, found: Found, folder: str) -> str:
    """Return the section of one study; it says so where a setting has no result."""
    if not found:
        return f"### `{name}`\n\n**No result.**  `python -m experiments.{name}` was not run, or failed.\n"
    shown = found.get("full") or found["quick"]
    lines = [f"### {shown['title']}: `{name}`\n", _state(found) + "\n"]
    if shown["source"]:
        lines.append(f"Compared with: {shown['source']}.\n")
    lines += _table(found) + [""]
    lines += [f"- {key}: {words}" for key, words in shown["conditions"].items()]
    lines.append(f"- seeds: {ranges(shown['seeds'])}\n")
    if shown["not_reproduced"]:
        lines += ["Not reproduced:\n", *[f"- {words}" for words in shown["not_reproduced"]], ""]
    if shown.get("figure"):
        lines.append(f"![{shown['title']}]({folder}/{shown['setting']}/{shown['figure']})\n")
    return "\n".join(lines)


def ranges(seeds: list[int]) -> str:
    """Return whole numbers with runs of them written as ranges.

    Examples
    --------
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
            words.append(f"{setting} setting: {spent}")
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
    known = [name for names in PAPERS.values() for name in names]
    lines = ["| study | full | quick |", "| --- | --- | --- |"]
    for name in [*known, *OUR_OWN, *sorted(set(found) - set(known) - set(OUR_OWN))]:
        marks = ["yes" if setting in found.get(name, {}) else "**missing**" for setting in SETTINGS]
        lines.append(f"| `{name}` | {' | '.join(marks)} |")
    return "\n".join(lines) + "\n"


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
    """Read the results of a folder and write RESULTS.md in one step."""
    link = Path(os.path.relpath(results, out.parent)).as_posix()
    text = page(read_all(results), link)
    with atomic_write(out) as temporary:
        temporary.write_text(text, encoding="utf-8")


def main() -> None:
    """Write RESULTS.md."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--results", type=Path, default=Path("results"), metavar="FOLDER")
    parser.add_argument("--out", type=Path, default=Path("RESULTS.md"))
    options = parser.parse_args()
    write_page(options.results, options.out)


if __name__ == "__main__":
    main()
