"""The processes of a search end with the one that started them, however it ends."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

ROOT = Path(__file__).resolve().parents[4]
SEARCH = """
import itertools, signal, sys, time
from lungaccess.planning.searches import parallel_steps
from lungaccess.planning.coupled.search.base import Step

class Incumbent:
    step = None

class Search:
    incumbent = Incumbent()
    def direct_steps(self): return iter(())
    def take_part(self, number, processes): pass
    def is_futile(self, iteration): return False
    def further_steps(self):
        while True:
            time.sleep(0.001)
            yield Step(iteration=0, phase="local search")

signal.signal(signal.SIGTERM, signal.default_int_handler)
try:
    for _ in parallel_steps(Search(), 2):
        print("round", flush=True)
except KeyboardInterrupt:
    sys.exit(130)
"""


@pytest.mark.parametrize(
    ("end", "code"),
    [(signal.SIGKILL, -signal.SIGKILL), pytest.param(signal.SIGTERM, 130, marks=pytest.mark.slow)],
)
def test_no_process_stays(end: signal.Signals, code: int) -> None:
    words, where = [sys.executable, "-c", SEARCH], {**os.environ, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True, cwd=ROOT, env=where) as process:
        assert process.stdout is not None and process.stdout.readline() == "round\n"
        workers = psutil.Process(process.pid).children(recursive=True)
        process.send_signal(end)
        assert process.wait(20.0) == code
    assert len(workers) == 2
    _gone, alive = psutil.wait_procs(workers, timeout=20.0)
    for each in alive:
        each.kill()
    assert not alive
