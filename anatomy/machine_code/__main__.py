"""Compile kernels before they are called: `python -m anatomy.machine_code [COMMAND ...]`; or all."""

from __future__ import annotations

import sys

from anatomy.machine_code.ahead import compile_ahead

if __name__ == "__main__":
    compile_ahead(sys.argv[1:], fewest=1, tell=lambda words: sys.stderr.write(f"\rkernels: {words} "))
