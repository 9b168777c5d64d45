"""Measure the manifest of the benchmark `synthetic-v1` anew, phantom by phantom.

    python -m experiments.synthetic_manifest FILE

FILE is written as the package ships it.  A benchmark never changes: if the two differ, the generator did, and
what is needed is a new version of the benchmark, not a new manifest of this one.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from anatomy.build import build_lung
from anatomy.io.files import write_text
from lungaccess.benchmark.synthetic.manifest import Entry, manifest_text, measured_entry, unproved_phantom
from lungaccess.benchmark.synthetic.phantoms import benchmark_phantoms


def main() -> None:
    """Measure all phantoms and write the manifest."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("file", type=Path)
    measured: dict[str, Entry] = {}
    file = parser.parse_args().file
    for case in benchmark_phantoms():
        images = unproved_phantom(case).images
        measured[case.name] = measured_entry(case, images, build_lung(images))
        print(f"{case.name}: masks {measured[case.name].masks_sha256[:16]}", flush=True)
    write_text(file, manifest_text(measured))


if __name__ == "__main__":
    main()
