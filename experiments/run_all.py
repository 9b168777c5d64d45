"""Run all studies one after the other, each in a process of its own, and make RESULTS.md.

    python -m experiments.run_all [--quick] [--results FOLDER] [--out RESULTS.md] [--studies NAME ...]

A study that fails does not stop the others: its old result of this setting is removed, RESULTS.md says that
it is missing, and the exit code is 1.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

from experiments.support.results import setting_of, study_parser
from experiments.write_results import OUR_OWN, PAPERS, write_page

STUDIES = (*(name for names in PAPERS.values() for name in names), *OUR_OWN)
ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
"""CPU times are those of one core."""


def run_study(name: str, folder: Path, setting: str, seed: int) -> bool:
    """Run one study; return whether it stored a result, and remove its old one where it did not."""
    file = folder / setting / f"{name}.json"
    before = _stamp(file)
    command = [sys.executable, "-m", f"experiments.{name}", "--results", str(folder), "--seed", str(seed)]
    began = time.monotonic()
    code = subprocess.run(
        [*command, *(["--quick"] if setting == "quick" else [])], env=os.environ | ONE_THREAD
    )
    done = code.returncode == 0 and _stamp(file) not in (None, before)
    if not done:
        file.unlink(missing_ok=True)
        file.with_suffix(".png").unlink(missing_ok=True)
    print(f"== {name}: {'done' if done else 'FAILED'} after {time.monotonic() - began:.0f} s", flush=True)
    return done


def _stamp(file: Path) -> tuple[int, int] | None:
    try:
        found = file.stat()
    except FileNotFoundError:
        return None
    return found.st_ino, found.st_mtime_ns


def main() -> int:
    """Run the studies; return 1 if one failed."""
    parser = study_parser(__doc__)
    parser.add_argument("--out", type=Path, default=Path("RESULTS.md"))
    parser.add_argument("--studies", nargs="+", choices=STUDIES, default=STUDIES, metavar="NAME")
    options = parser.parse_args()
    failed = []
    for name in options.studies:
        print(f"== {name}", flush=True)
        if not run_study(name, options.results, setting_of(options), options.seed):
            failed.append(name)
    write_page(options.results, options.out)
    if failed:
        print(f"No result of: {', '.join(failed)}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
