"""The process that answers the cases in plain Python: `python -m lungaccess.selftest.plain KIND ...`.

It runs with NUMBA_DISABLE_JIT=1, so that the sources of the kernels run as they are, and numpy tests every
index of an array.  It prints what it found as JSON.
"""

from __future__ import annotations

import json
import sys
from typing import Any

from anatomy.child_process import end_with_parent
from lungaccess.selftest.kinds import KINDS


def main(names: list[str]) -> None:
    """Answer the cases of some kinds; print, by kind and seed, the numbers or an error in words."""
    end_with_parent()
    found: dict[str, dict[str, Any]] = {}
    for name in names:
        found[name] = {}
        for seed in KINDS[name].seeds:
            try:
                found[name][str(seed)] = KINDS[name].case(seed).answers.tolist()
            except Exception as error:  # Whatever a broken kernel does is a result.
                found[name][str(seed)] = f"{type(error).__name__}: {error}"
    json.dump(found, sys.stdout)


if __name__ == "__main__":
    main(sys.argv[1:])
