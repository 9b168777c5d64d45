"""A study on a cluster: complete, resumed, the same everywhere, whatever dies on the way."""

from __future__ import annotations

import contextlib
import os
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from distributed import LocalCluster

from anatomy.base.errors import FileError
from lungaccess.running.study import driver, one_run
from lungaccess.running.study.driver import StudyDone, open_results, run_study
from lungaccess.running.study.results import ResultsFile
from lungaccess.running.study.runs import Answer, Run
from lungaccess.running.study.settings import Study, StudyError, study_of
from lungaccess.running.study.tables import differences
from tests.lungaccess.running.study.toys import content, toy_answer

LONGER = {"case": {"targets": [], "peripheral": {"per_lung": 4}}, "seeds": [0, 1, 2]}
SOON_S = 0.05


@pytest.fixture
def cluster() -> Iterator[str]:
    """Return the address of a scheduler within this process, with one worker in a thread of it."""
    with LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address="127.0.0.1:0", protocol="inproc"
    ) as made:
        yield made.scheduler_address


@pytest.fixture
def made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Let the worker answer at once; return a file with a line for each run that was made."""
    file = tmp_path / "made.txt"
    file.touch()

    def answer(run: Run, cache: Path | None = None) -> Answer:
        note(file, run.key)
        return toy_answer(run)

    monkeypatch.setattr(one_run, "answer", answer)
    monkeypatch.setattr(one_run, "prepare", lambda problem, cache=None: None)
    return file


def note(file: Path, line: str) -> None:
    with file.open("a") as stream:
        stream.write(line + "\n")


def test_a_study_goes_on_from_what_is_stored(
    tmp_path: Path, cache: Path, cluster: str, made: Path, runs: list[Run]
) -> None:
    path, told = tmp_path / "r.db", list[tuple[str, float | None]]()
    with ResultsFile(path, create=True) as results:
        results.add(runs[1], replace(toy_answer(runs[1]), kernels="others"))

    def start(study: Study) -> StudyDone:
        return run_study(
            study, path, scheduler=cluster, cache=cache, progress=lambda *said: told.append(said)
        )

    done = start(study_of(content()))
    assert (done.runs, done.stored_before, done.added, done.failed) == (4, 1, 3, 0)
    assert [share for _words, share in told if share is not None] == [1 / 3, 2 / 3, 1.0]
    keys = made.read_text().split()
    assert sorted(keys) == sorted({run.key for run in runs} - {runs[1].key})
    again = start(study_of(content()))
    assert (again.runs, again.stored_before, again.added) == (4, 4, 0)
    assert (done.other_kernels, again.other_kernels) == (1, 1)
    assert made.read_text().split() == keys
    more = start(study_of(content(seeds=[0, 1, 2])))
    assert (more.runs, more.stored_before, more.added) == (6, 4, 2)
    with sqlite3.connect(path) as connection:
        connection.execute("DROP TABLE made_with")
    earlier = start(study_of(content()))
    assert (earlier.stored_before, earlier.other_kernels) == (4, 4), "an earlier version did not state them"


def test_a_second_study_does_not_add_to_the_same_file(tmp_path: Path, study: Study, cache: Path) -> None:
    path = tmp_path / "r.db"
    with open_results(path, scheduler=None, workers=1, cache=cache):
        with pytest.raises(FileError, match="Another command writes its results into"):
            run_study(study, path, workers=1, cache=cache)
        with ResultsFile(path) as results:
            assert not results.finished_keys()


def test_a_run_that_cannot_be_made_is_stored_and_made_again(
    tmp_path: Path, cache: Path, cluster: str, made: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tries = tmp_path / "tries.txt"

    def refuse(run: Run, cache: Path | None = None) -> Answer:
        if run.seed == 1:
            note(tries, run.key)
            raise FileError("The mask is not there")
        return toy_answer(run)

    working = one_run.answer
    monkeypatch.setattr(one_run, "answer", refuse)
    path, study = tmp_path / "r.db", study_of(content())
    done = run_study(study, path, scheduler=cluster, cache=cache)
    assert (done.added, done.failed) == (4, 2)
    assert len(tries.read_text().split()) == 2 * (1 + driver.RETRIES)
    with ResultsFile(path) as results:
        query = "SELECT outcome, message FROM outcomes WHERE failed"
        assert list(results.rows(query)) == [("FileError", "The mask is not there.")] * 2
    monkeypatch.setattr(one_run, "answer", working)
    done = run_study(study, path, scheduler=cluster, cache=cache)
    assert (done.runs, done.stored_before, done.added, done.failed) == (4, 2, 2, 0)


COUNT_THREADS = """
import numba
from lungaccess.running.study import driver

def threads():
    return numba.config.NUMBA_NUM_THREADS

if __name__ == "__main__":
    with driver.connect(None, 1) as client:
        print(client.submit(threads).result())
"""


@pytest.mark.slow
def test_a_worker_has_one_thread_from_its_beginning(tmp_path: Path) -> None:
    """It imports what the script imports, before dask can change anything."""
    script = tmp_path / "script.py"
    script.write_text(COUNT_THREADS)
    environment = os.environ | {"PYTHONPATH": str(Path(driver.__file__).parents[3])}
    environment.pop("NUMBA_NUM_THREADS", None)
    done = subprocess.run(
        [sys.executable, str(script)], env=environment, capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == ["1"]


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_an_interruption_ends_a_study_also_while_something_is_being_deleted(
    tmp_path: Path, cache: Path, cluster: str, made: Path
) -> None:
    """Python prints an exception that is raised in `__del__`, and goes on."""
    told: list[float] = []

    class Interrupting:
        def __del__(self) -> None:
            signal.raise_signal(signal.SIGINT)

    def tell(_words: str, share: float | None) -> None:
        if share is not None:
            told.append(share)
            Interrupting()

    path = tmp_path / "r.db"
    # A shell lets jobs in the background ignore it.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            run_study(study_of(content()), path, scheduler=cluster, cache=cache, progress=tell)
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)
    assert told == [0.25]
    with ResultsFile(path) as results:
        assert len(results.finished_keys()) == 1


def test_only_a_few_runs_wait_at_the_scheduler_and_nothing_of_the_others_stays(
    tmp_path: Path, cache: Path, cluster: str, made: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from distributed import Client

    waiting: list[int] = []
    beginnings: list[int] = []
    add = ResultsFile.add
    with Client(cluster) as watcher:

        def added(results: ResultsFile, run: Run, answer: Answer) -> bool:
            waiting.append(watcher.run_on_scheduler(lambda dask_scheduler: len(dask_scheduler.tasks)))
            kept = watcher.run_on_scheduler(lambda dask_scheduler: len(dask_scheduler.task_prefixes))
            beginnings.append(kept)
            return add(results, run, answer)

        monkeypatch.setattr(ResultsFile, "add", added)
        study = study_of(content(seeds=list(range(30))))
        assert run_study(study, tmp_path / "r.db", scheduler=cluster, cache=cache).added == 60
    assert len(waiting) == 60
    assert max(waiting) <= driver.LEAST_RUNS + 1
    assert beginnings[-1] == beginnings[0], "statistics that dask keeps for good"


@pytest.mark.slow
def test_a_full_disk_ends_the_study_and_keeps_what_is_stored(
    tmp_path: Path, cache: Path, cluster: str, made: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begin = ResultsFile._begin

    def small(results: ResultsFile) -> None:
        begin(results)
        results._connection.execute("PRAGMA max_page_count = 40")

    study, path = study_of(content(seeds=list(range(200)))), tmp_path / "r.db"
    with monkeypatch.context() as limited:
        limited.setattr(ResultsFile, "_begin", small)
        with pytest.raises(FileError, match="cannot be written"):
            run_study(study, path, scheduler=cluster, cache=cache)
    done = run_study(study, path, scheduler=cluster, cache=cache)
    assert 0 < done.stored_before < 400
    assert done.stored_before + done.added == 400


def test_without_dask_the_error_says_what_to_install(
    tmp_path: Path, study: Study, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(StudyError, match=r"pip install 'lungaccess\[study\]'"):
        run_study(study, tmp_path / "r.db")
    assert not (tmp_path / "r.db").exists()


def test_no_scheduler(tmp_path: Path, study: Study, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(driver, "CONNECT_S", 0.2)
    for address in ("tcp://127.0.0.1:1", "nonsense://x", "127.0.0.1:abc"):
        with pytest.raises(StudyError, match="No dask scheduler answers"):
            run_study(study, tmp_path / "r.db", scheduler=address, cache=cache)


def test_importing_the_commands_does_not_import_dask() -> None:
    script = "import lungaccess.cli.app, sys; print({'dask', 'distributed', 'pyarrow'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


def wait_until(true: Callable[[], Any]) -> None:
    while not true():
        time.sleep(SOON_S)


@contextlib.contextmanager
def process(*words: str) -> Iterator[subprocess.Popen[bytes]]:
    """Start a Python process of its own group, and kill that group at the end."""
    with subprocess.Popen(
        [sys.executable, "-m", *words],
        start_new_session=True,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    ) as made:
        try:
            yield made
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(made.pid, signal.SIGKILL)


def stored(path: Path) -> int:
    if not path.is_file():
        return 0
    try:
        with ResultsFile(path) as results:
            return len(results.finished_keys())
    except FileError:
        return 0


@pytest.mark.slow
def test_a_worker_killed_midway_loses_nothing(tmp_path: Path, cache: Path) -> None:
    """Processes of this machine: dask starts another worker in the killed one's place."""
    import psutil

    quiet, disturbed = tmp_path / "quiet.db", tmp_path / "disturbed.db"
    study, killed = study_of(content(**LONGER)), list[int]()
    assert run_study(study, quiet, workers=1, cache=cache).added == 24

    def kill(words: str, _share: float | None) -> None:
        if words.startswith(("3 of", "9 of")):
            workers = [
                each
                for each in psutil.Process().children(recursive=True)
                if "spawn_main" in " ".join(each.cmdline())
            ]
            workers[0].kill()
            killed.append(workers[0].pid)

    done = run_study(study, disturbed, workers=1, cache=cache, progress=kill)
    assert (done.added, done.failed, len(killed)) == (24, 0, 2)
    assert differences(quiet, disturbed) == []


@pytest.mark.slow
def test_a_separate_scheduler_with_workers_gives_the_same(tmp_path: Path, cache: Path) -> None:
    """The scheduler and two workers are processes of their own; one worker is killed midway."""
    here, there, file = tmp_path / "here.db", tmp_path / "there.db", tmp_path / "scheduler.json"
    study = study_of(content(**LONGER))
    run_study(study, here, workers=1, cache=cache)
    with contextlib.ExitStack() as stack:
        words = ("--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(file))
        stack.enter_context(process("distributed.cli.dask_scheduler", *words))
        wait_until(file.is_file)
        words = ("--scheduler-file", str(file), "--nthreads", "1", "--no-dashboard", "--memory-limit", "0")
        first, _second = (
            stack.enter_context(process("distributed.cli.dask_worker", *words)) for _ in range(2)
        )

        def kill(words: str, _share: float | None) -> None:
            if words.startswith("5 of"):
                os.killpg(first.pid, signal.SIGKILL)

        import json

        address = json.loads(file.read_text())["address"]
        done = run_study(study, there, scheduler=address, cache=cache, progress=kill)
    assert (done.added, done.failed) == (24, 0)
    assert first.returncode == -signal.SIGKILL
    assert differences(here, there) == []
