"""Wrong and hard inputs of the segmentation: each right, warned of or refused.

    python -m experiments.hard_inputs [--only PATTERN] [--record FILE] [--page FILE]

Each case of `experiments.support.segmentation.hard_cases` is made of the CT of the small phantom, segmented
up
to the airways, and compared with the truth.  Cases in the record are not run again, so that a study that was
stopped goes on.  The page gets the table between its marks.
"""

from __future__ import annotations

import argparse
import json
import re
from dataclasses import asdict
from pathlib import Path

from anatomy.phantom import make_phantom
from experiments.support.segmentation.hard_cases import CASES
from experiments.support.segmentation.hard_images import phantom_image
from experiments.support.segmentation.hard_runs import Outcome, run

PLAIN = "axes: as it is"
SEED = 3
FIRST, LAST = "<!-- hard inputs -->", "<!-- end of hard inputs -->"


def outcomes(record: Path, pattern: str) -> dict[str, Outcome]:
    """Run the cases whose name fits and that the record does not hold, and return all in the record."""
    known = {}
    if record.is_file():
        known = {name: Outcome(**row) for name, row in json.loads(record.read_text()).items()}
    image = phantom_image(make_phantom(seed=SEED, size="small"))
    if PLAIN not in known:
        known[PLAIN] = run(CASES[PLAIN], image)
    for name, case in CASES.items():
        if name not in known and re.search(pattern, name):
            known[name] = run(case, image, known[PLAIN].tree)
            print(f"{known[name].verdict:16} {name}", flush=True)
            record.parent.mkdir(parents=True, exist_ok=True)
            record.write_text(json.dumps({n: asdict(o) for n, o in known.items()}, indent=1) + "\n")
    return {name: known[name] for name in CASES if name in known}


def table(found: dict[str, Outcome]) -> str:
    """Return the outcomes as a table of a page."""
    counts = dict.fromkeys(("right", "warned", "refused"), 0)
    for outcome in found.values():
        counts[outcome.verdict] = counts.get(outcome.verdict, 0) + 1
    total = ", ".join(f"{count} {verdict}" for verdict, count in counts.items())
    rows = [
        f"{len(found)} cases: {total}.",
        "",
        "| input | outcome | Dice right, left | tree | what is said first |",
        "|---|---|---|---|---|",
    ]
    for name, o in found.items():
        plain = o.tree if name != PLAIN else 1.0
        figures = (
            ("", "") if o.verdict.startswith("refused") else (f"{o.right:.3f}, {o.left:.3f}", f"{plain:.2f}")
        )
        first = o.said.split(". ")[0].split(": about")[0].rstrip(".").replace("|", "/")
        rows.append(f"| {name} | {o.verdict} | {figures[0]} | {figures[1]} | {first[:110]} |")
    return "\n".join(rows)


def main(arguments: list[str] | None = None) -> None:
    """Run the suite and write its table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", default="", metavar="PATTERN", help="cases whose name fits")
    parser.add_argument("--record", type=Path, default=Path(".studies/hard_inputs.json"))
    parser.add_argument("--page", type=Path, help="page with the two marks; the table is printed if left out")
    options = parser.parse_args(arguments)
    made = table(outcomes(options.record, options.only))
    if options.page is None:
        print(made)
        return
    text = options.page.read_text(encoding="utf-8")
    before, after = text.split(FIRST)[0], text.split(LAST)[1]
    options.page.write_text(f"{before}{FIRST}\n\n{made}\n\n{LAST}{after}", encoding="utf-8")


if __name__ == "__main__":
    main()
