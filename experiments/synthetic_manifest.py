"""Measure the manifest of the benchmark `synthetic-v1` anew, phantom by phantom.

    python -m experiments.synthetic_manifest FILE

FILE is written as the package ships it.  A released benchmark never changes: if the two differ, the generator
did, and what is needed is a new version of the benchmark, not a new manifest of this one.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from anatomy.base.files import write_text
from lungaccess.running.benchmark.synthetic.manifest import Entry, manifest_text, measured_entry
from lungaccess.running.benchmark.synthetic.phantoms import benchmark_phantoms


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
