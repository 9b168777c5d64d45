"""Wrong and hard inputs of the segmentation: each right, warned of or refused.

    python -m experiments.hard_inputs [--only PATTERN] [--record FILE] [--page FILE] [--ct FILE] [--seed N]

Each case of `experiments.support.segmentation.hard_cases` is made of the CT of the small phantom, segmented
up to the airways, and compared with the truth.  Cases in the record are not run again, so that a study that
was stopped goes on.  The page gets the table between its marks.

With --ct the cases are made of a real CT, as far as they do not need to know where its organs lie.  Its own
segmentation stands for the truth: what is measured is what the change does.
"""

from __future__ import annotations

import argparse
import json
import re
from dataclasses import asdict
from pathlib import Path

import numpy as np

from anatomy.grid import Volume
from anatomy.lobes import LEFT_UPPER, RIGHT_UPPER
from anatomy.phantom import make_phantom
from anatomy.segmentation.pipeline import read_ct
from anatomy.tree import tree_from_mask
from experiments.support.segmentation.hard_cases import CASES
from experiments.support.segmentation.hard_images import HardImage, phantom_image
from experiments.support.segmentation.hard_runs import Outcome, plain_tree, run, segmented

SEED = 3
ANYWHERE = ("axes", "header", "scale", "shift", "noise", "slices")
"""Groups of cases that need not know where the organs lie."""
FIRST, LAST = "<!-- hard inputs -->", "<!-- end of hard inputs -->"


def ct_image(path: Path) -> HardImage:
    """Return a real CT with its own segmentation in place of the truth."""
    ct, _ = read_ct(path)
    lungs, lumen, _ = segmented(ct)
    lobes = np.where(lungs.right, RIGHT_UPPER, 0) + np.where(lungs.left, LEFT_UPPER, 0)
    tree = tree_from_mask(Volume(grid=ct.grid, array=lumen))
    return HardImage(
        hu=ct.array.astype(np.float32),
        lobes=lobes.astype(np.uint8),
        lumen=lumen,
        grid=ct.grid,
        tree_lps=tree.points_lps,
    )


def outcomes(record: Path, pattern: str, ct: Path | None, seed: int) -> dict[str, Outcome]:
    """Run the cases whose name fits and that the record does not hold, and return all in the record."""
    known = {}
    if record.is_file():
        known = {name: Outcome(**row) for name, row in json.loads(record.read_text()).items()}
    image = phantom_image(make_phantom(seed=seed, size="small")) if ct is None else ct_image(ct)
    plain = plain_tree(image)
    for name, case in CASES.items():
        anywhere = ct is None or case.group in ANYWHERE
        if name not in known and anywhere and re.search(pattern, name):
            known[name] = run(case, image, plain)
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
        figures = (
            ("", "") if o.verdict.startswith("refused") else (f"{o.right:.3f}, {o.left:.3f}", f"{o.tree:.2f}")
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
    parser.add_argument("--ct", type=Path, help="a real CT instead of the phantom")
    parser.add_argument(
        "--seed", type=int, default=SEED, help="the phantom, of which each has its own record"
    )
    parser.add_argument("--page", type=Path, help="page with the two marks; the table is printed if left out")
    options = parser.parse_args(arguments)
    made = table(outcomes(options.record, options.only, options.ct, options.seed))
    if options.page is None:
        print(made)
        return
    text = options.page.read_text(encoding="utf-8")
    before, after = text.split(FIRST)[0], text.split(LAST)[1]
    options.page.write_text(f"{before}{FIRST}\n\n{made}\n\n{LAST}{after}", encoding="utf-8")


if __name__ == "__main__":
    main()
