"""A study that is killed again and again ends with the results of one that is left alone."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from lungaccess.plans.plan import Plan
from lungaccess.running.study.driver import run_study
from lungaccess.running.study.results import ResultsFile
from lungaccess.running.study.settings import read_study
from lungaccess.running.study.tables import differences
from tests.lungaccess.cli.killing import require_gone
from tests.lungaccess.running.study.test_study_command import TOML, command, stored

RUNS, KILLS = 400, 40
STUDY = TOML.replace("[0, 1]", str(list(range(RUNS // 4)))).replace(
    'targets = ["lps:-81.25,51,-33.5", "lps:300,0,0"]',
    'targets = ["lps:-81.25,51,-33.5", "lps:300,0,0"]\nperipheral = {per_lung = 1, seed = 1}',
)


def killed_at_random(words: list[str], path: Path, rng: random.Random) -> bool:
    """Start a study and kill it at a random moment; return whether it was still running.

    Of three kills, one is of all its processes and one of the first alone, which leaves the others to end by
    themselves; the third is a request to end (SIGTERM).
    The moment is counted in runs stored since the start, and then in time, so that it falls anywhere: while
    workers start, while a run is made, while it is written.
    """
    more, later_s = rng.choice((0, 1, 3, 8, 15)), rng.uniform(0.0, 2.0)
    kind = rng.choice(("all", "first", "end"))
    before = stored(path)
    with subprocess.Popen(
        words, start_new_session=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    ) as process:
        while process.poll() is None and stored(path) < before + more:
            time.sleep(0.005)
        time.sleep(later_s)
        running = process.poll() is None
        if running and kind == "all":
            os.killpg(process.pid, signal.SIGKILL)
        elif running:
            process.send_signal(signal.SIGKILL if kind == "first" else signal.SIGTERM)
        process.wait()
        require_gone(process.pid)
    return running


@pytest.mark.slow
def test_killed_forty_times_and_resumed(tmp_path: Path, cache: Path) -> None:
    file, path, quiet = tmp_path / "study.toml", tmp_path / "killed.db", tmp_path / "quiet.db"
    file.write_text(STUDY)
    words, rng, kills = command(file, path, cache), random.Random(20), 0
    counts = []
    while kills < KILLS:
        kills += killed_at_random(words, path, rng)
        counts.append(stored(path))
        assert counts[-1] < RUNS, "the study ended before it was killed often enough"
        assert counts == sorted(counts)
    subprocess.run(words, check=True, stdout=subprocess.DEVNULL)
    sys.stdout.write(f"stored after each kill: {counts}\n")
    assert run_study(read_study(file), quiet, workers=1, cache=cache).added == RUNS
    with ResultsFile(path) as results:
        assert len(results.finished_keys()) == RUNS
        assert next(results.rows("SELECT count(*), count(DISTINCT key) FROM runs")) == (RUNS, RUNS)
        assert list(results.rows("PRAGMA integrity_check")) == [("ok",)]
        assert list(results.rows("PRAGMA foreign_key_check")) == []
        plans = [Plan.from_json(text) for (text,) in results.rows("SELECT plan FROM plans")]
    assert len(plans) >= RUNS // 4
    assert differences(quiet, path) == []
