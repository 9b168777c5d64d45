"""What a piece of work costs in a new process, without and with cached kernels."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
"""asv runs benchmarks somewhere else, and what a new process can import depends on where it starts."""


class FreshProcess:
    """Base of benchmarks that run `code` in a new process; each names a method that calls `run`."""

    code = ""
    params = (True, False)
    param_names = ("cold",)
    timeout = 300
    number = 1
    repeat = 1
    warmup_time = 0.0

    def setup(self, cold: bool) -> None:
        """Choose an empty or a filled kernel cache."""
        self.environment = {**os.environ, "NUMBA_CACHE_DIR": tempfile.mkdtemp()}
        if not cold:
            self.run()

    def run(self) -> None:
        """Run the code once."""
        subprocess.run([sys.executable, "-c", self.code], check=True, env=self.environment, cwd=ROOT)
