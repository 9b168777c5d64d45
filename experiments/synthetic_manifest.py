"""Measure the manifest of the benchmark `synthetic-v1` anew, phantom by phantom.

    python -m experiments.synthetic_manifest FILE

FILE is written as the package ships it.  A released benchmark never changes: if the two differ, the generator
did, and what is needed is a new version of the benchmark, not a new manifest of this one.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Mapping
from pathlib import Path

from anatomy.base.files import write_text
from anatomy.build import build_lung
from anatomy.io.patients import load_patient
from anatomy.phantom import write_phantom
from lungaccess.problem.peripheral import peripheral_targets
from lungaccess.running.benchmark.synthetic.cases import (
    TARGETS_A_LUNG,
    VERSION,
    BenchmarkPhantom,
    Entry,
    benchmark_phantoms,
    masks_sha256,
    unproved_phantom,
)

DIGITS = 3
"""Targets are stated to a micrometre."""


def measured_entry(case: BenchmarkPhantom, folder: Path) -> Entry:
    """Make a phantom and return what a manifest says of it.

    The phantom goes through files, as it does for every planner and every score: a NIfTI file keeps the grid
    in single precision, and the targets are drawn from distances on the grid as it is read.

    Args:
        folder: Where its masks are written.

    Raises:
        FileError: If the folder cannot be written to.
        TargetError: If one of its lungs has no place for a target.
    """
    write_phantom(unproved_phantom(case), folder, with_ct=False)
    images = load_patient(folder)
    points = peripheral_targets(build_lung(images), TARGETS_A_LUNG, case.seed).round(DIGITS).tolist()
    return Entry(masks_sha256=masks_sha256(images), targets_lps=tuple((x, y, z) for x, y, z in points))


def manifest_text(measured: Mapping[str, Entry]) -> str:
    """Return the text of a manifest."""
    phantoms = {
        name: {"masks_sha256": entry.masks_sha256, "targets_lps": [list(p) for p in entry.targets_lps]}
        for name, entry in measured.items()
    }
    return json.dumps({"benchmark": VERSION, "phantoms": phantoms}, indent=1) + "\n"


def main() -> None:
    """Measure all phantoms and write the manifest."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("file", type=Path)
    measured: dict[str, Entry] = {}
    file = parser.parse_args().file
    for case in benchmark_phantoms():
        with tempfile.TemporaryDirectory() as folder:
            measured[case.name] = measured_entry(case, Path(folder))
        print(f"{case.name}: masks {measured[case.name].masks_sha256[:16]}", flush=True)
    write_text(file, manifest_text(measured))


if __name__ == "__main__":
    main()
