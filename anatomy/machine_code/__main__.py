"""Compile kernels before they are called: `python -m anatomy.machine_code [COMMAND ...]`; or all."""

from __future__ import annotations

import sys

from anatomy.machine_code.ahead import compile_ahead

if __name__ == "__main__":
    shown = sys.stderr.write if sys.stderr.isatty() else len
    done = compile_ahead(sys.argv[1:], tell=lambda words: shown(f"\rkernels: {words} "))
    sys.stderr.write(f"\r{done} kernels compiled\n" if done else "")
