"""The results file of a study: SQLite, one transaction a run, each run at most once."""

import contextlib
import datetime
import json
import platform
import sqlite3
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from anatomy.base.errors import FileError
from anatomy.base.settings import to_mapping
from lungaccess.plans.version import software_version
from lungaccess.running.study.runs import STATUS, Answer, Problem, Run
from stages.needle import TERMS


class ResultsFile:
    """A results file, open for reading and adding; for a `with` statement.

    Several processes may have the same file open.  FileError is raised if the file is not there, cannot be
    written, is damaged, or is not a results file of this format.

    Args:
        create: Whether a file that is not there is made.
    """

    def __init__(self, path: Path, *, create: bool = False) -> None:
        self.path = Path(path)
        if not create and not (self.path.is_file() and self.path.stat().st_size):
            raise FileError(
                f"There is no file {path}, or it is empty",
                expected="a results file of `lungaccess study run`",
                remedy="Check the name, or run the study: lungaccess study run study.toml --out results.db",
            )
        with _file_errors(self.path):
            self._connection = sqlite3.connect(self.path, timeout=BUSY_S, isolation_level=None)
            try:
                self._begin()
            except BaseException:
                self._connection.close()
                raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._connection.close()

    def _begin(self) -> None:
        """Make a new file's tables, or make sure that an old one is sound."""
        if self._is_new():
            self._connection.execute("PRAGMA journal_mode = WAL")
            self._make()
        identity = (self._number("application_id"), self._number("user_version"))
        if identity != (APPLICATION_ID, FORMAT):
            raise FileError(
                f"{self.path} is a database of another kind or format ({identity[0]}, {identity[1]})",
                expected=f"results of lungaccess, format {FORMAT}",
                remedy="Choose another file with --out",
            )
        self._connection.execute("PRAGMA foreign_keys = ON")
        verdict = self._connection.execute("PRAGMA integrity_check(1)").fetchone()[0]
        if verdict != "ok":
            raise damaged(self.path, verdict)

    def _is_new(self) -> bool:
        """Tell whether there is nothing in the file, which another process may be about to change."""
        return (
            self._number("application_id") == 0
            and not self._connection.execute("SELECT 1 FROM sqlite_master LIMIT 1").fetchall()
        )

    def _make(self) -> None:
        try:
            self._connection.executescript(_statements())
        except sqlite3.OperationalError:
            # Another process may have made the tables in between.
            if self._connection.in_transaction:
                self._connection.execute("ROLLBACK")
            if self._is_new():
                raise

    def _number(self, pragma: str) -> int:
        return int(self._connection.execute(f"PRAGMA {pragma}").fetchone()[0])

    def rows(self, query: str, values: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
        """Yield the rows of a query; FileError if the file cannot be read."""
        with _file_errors(self.path):
            cursor = self._connection.execute(query, values)
        while True:
            with _file_errors(self.path):
                # Rows that are read at once: a few of them take no time, and all of them would fill the
                # memory.
                batch = cursor.fetchmany(1000)
            if not batch:
                return
            yield from batch

    def columns(self, query: str) -> tuple[str, ...]:
        """Return the names of the columns of a query; FileError if the file cannot be read."""
        with _file_errors(self.path):
            found = self._connection.execute(f"SELECT * FROM ({query}) LIMIT 0").description
        return tuple(each[0] for each in found)

    def finished_keys(self) -> set[str]:
        """Return the keys of the runs that need not be made again: all but those that failed."""
        query = "SELECT key FROM runs JOIN outcomes ON runid = id WHERE NOT failed"
        return {key for (key,) in self.rows(query)}

    def made_with_other_kernels(self, keys: set[str], kernels: str) -> int:
        """Return how many of the runs with these keys other kernels made, or none that are stated."""
        stated = "SELECT key FROM runs JOIN made_with ON runid = id WHERE kernels = ?"
        known = self._connection.execute("SELECT 1 FROM sqlite_master WHERE name = 'made_with'").fetchone()
        return len(keys - {key for (key,) in self.rows(stated, (kernels,))} if known else keys)

    def add(self, run: Run, answer: Answer) -> bool:
        """Store what a run ended with, all of it or nothing; return whether it was new.

        A run that is there already stays as it is, unless it failed.  FileError is raised if the disk is
        full, another program holds the file for too long, or it is damaged.
        """
        with _file_errors(self.path), self._transaction() as connection:
            connection.execute(
                "DELETE FROM runs WHERE key = ? AND id IN (SELECT runid FROM outcomes WHERE failed)",
                (run.key,),
            )
            experiment, planner = self._experiment(run.problem), self._planner(run)
            made = self._insert("runs", _run_row(run, answer, experiment, planner), "INSERT OR IGNORE")
            if made.rowcount == 0:
                return False
            connection.execute(KERNELS_TABLE)
            _add_rest(connection, int(made.lastrowid or 0), answer)
            connection.execute(
                "UPDATE experiments SET totaltime = totaltime + ?, runcount = (SELECT max(n) FROM "
                "(SELECT count(*) AS n FROM runs WHERE experimentid = ? GROUP BY plannerid)) WHERE id = ?",
                (answer.time_s, experiment, experiment),
            )
        return True

    @contextlib.contextmanager
    def _transaction(self) -> Iterator[sqlite3.Connection]:
        self._connection.execute("BEGIN IMMEDIATE")
        try:
            yield self._connection
            self._connection.execute("COMMIT")
        except BaseException:
            # A full disk ends the transaction by itself.
            if self._connection.in_transaction:
                self._connection.execute("ROLLBACK")
            raise

    def _experiment(self, problem: Problem) -> int:
        """Return the number of the problem, which is stored if it is new."""
        known = self._connection.execute(
            "SELECT experimentid FROM problems WHERE key = ?", (problem.key,)
        ).fetchone()
        if known:
            return int(known[0])
        number = int(self._insert("experiments", _experiment_row(problem)).lastrowid or 0)
        self._insert("problems", _problem_row(problem, number))
        return number

    def _insert(self, table: str, row: dict[str, Any], how: str = "INSERT") -> sqlite3.Cursor:
        """Store a row of a table, given by the names of its columns."""
        words = f"{how} INTO {table} ({', '.join(row)}) VALUES ({', '.join('?' * len(row))})"
        return self._connection.execute(words, tuple(row.values()))

    def _planner(self, run: Run) -> int:
        settings = to_mapping(run.planner)
        row = (settings.pop("name"), json.dumps(settings, sort_keys=True))
        self._connection.execute("INSERT OR IGNORE INTO plannerConfigs (name, settings) VALUES (?, ?)", row)
        found = self._connection.execute(
            "SELECT id FROM plannerConfigs WHERE name = ? AND settings = ?", row
        ).fetchone()
        return int(found[0])


BUSY_S = 60.0
"""Longer than any other process needs for the transaction of a run."""


@contextlib.contextmanager
def _file_errors(path: Path) -> Iterator[None]:
    """Turn what SQLite raises into a FileError that says what to do."""
    try:
        yield
    except UnicodeDecodeError as error:
        raise damaged(path, str(error)) from error
    except sqlite3.Error as error:
        code = getattr(error, "sqlite_errorcode", 0) & 0xFF
        if code in (sqlite3.SQLITE_FULL, sqlite3.SQLITE_IOERR):
            raise FileError(
                f"{path} cannot be written: {error}",
                expected="room on the disk",
                remedy="What is stored is sound: make room and start the study again, it goes on from there",
            ) from error
        if code in (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED):
            raise FileError(
                f"{path} has been locked by another program for {BUSY_S:g} s",
                remedy="Close that program and start the study again, it goes on from there",
                expected="a file that no other program holds",
            ) from error
        if code in (sqlite3.SQLITE_NOTADB, sqlite3.SQLITE_CORRUPT):
            raise damaged(path, str(error)) from error
        raise FileError(
            f"{path} cannot be used: {error}",
            expected="a folder that exists and may be written to",
            remedy="Choose another file with --out",
        ) from error


def damaged(path: Path, why: str) -> FileError:
    """Return the error for a file that is no sound database."""
    return FileError(
        f"{path} is damaged or is not a database: {why}",
        expected="a results file of `lungaccess study run`",
        remedy="Restore it from a copy, or choose another file with --out and run the study again",
    )


APPLICATION_ID = 0x6C756E67
FORMAT = 1
"""Raise it when the tables change: a file of another format is refused."""

OMPL_TABLES = """
CREATE TABLE experiments (
    id INTEGER PRIMARY KEY AUTOINCREMENT, name VARCHAR(512), totaltime REAL, timelimit REAL,
    memorylimit REAL, runcount INTEGER, version VARCHAR(128), hostname VARCHAR(1024), cpuinfo TEXT,
    date DATETIME, seed VARCHAR(24), setup TEXT, target INTEGER, start INTEGER);
CREATE TABLE plannerConfigs (
    id INTEGER PRIMARY KEY AUTOINCREMENT, name VARCHAR(512) NOT NULL, settings TEXT,
    UNIQUE (name, settings));
CREATE TABLE enums (
    name VARCHAR(512), value INTEGER, description TEXT, PRIMARY KEY (name, value));
CREATE TABLE runs (
    id INTEGER PRIMARY KEY AUTOINCREMENT,
    experimentid INTEGER NOT NULL REFERENCES experiments(id) ON DELETE CASCADE,
    plannerid INTEGER NOT NULL REFERENCES plannerConfigs(id) ON DELETE CASCADE,
    time REAL, memory REAL, iterations INTEGER, solved BOOLEAN, correct_solution BOOLEAN, status ENUM,
    solution_length REAL, cpu_time REAL, first_solution_time REAL, solutions INTEGER, seed INTEGER,
    cost REAL, inverse_clearance REAL, cost_map REAL, voxel_sum REAL, key TEXT NOT NULL UNIQUE);
CREATE TABLE progress (
    runid INTEGER REFERENCES runs(id) ON DELETE CASCADE, time REAL, best_cost REAL, iterations INTEGER,
    PRIMARY KEY (runid, time));
"""
"""Their names and columns are those that `ompl.tools.readBenchmarkLog` makes of a log, so that Planner Arena
and SQL written for those databases read them.  An experiment is one problem: a target of a case."""

OUR_TABLES = """
CREATE TABLE problems (
    experimentid INTEGER PRIMARY KEY REFERENCES experiments(id) ON DELETE CASCADE,
    key TEXT NOT NULL UNIQUE, case_name TEXT NOT NULL, patient TEXT, lung TEXT NOT NULL, system TEXT NOT NULL,
    fissures_allowed BOOLEAN, objective TEXT NOT NULL, target INTEGER, origin TEXT,
    x_lps_mm REAL, y_lps_mm REAL, z_lps_mm REAL, start INTEGER, iterations INTEGER, time_s REAL);
CREATE TABLE outcomes (
    runid INTEGER PRIMARY KEY REFERENCES runs(id) ON DELETE CASCADE,
    outcome TEXT NOT NULL, failed BOOLEAN NOT NULL, message TEXT, advice TEXT);
CREATE TABLE plans (
    runid INTEGER PRIMARY KEY REFERENCES runs(id) ON DELETE CASCADE,
    digest TEXT NOT NULL, plan TEXT NOT NULL);
CREATE TABLE findings (
    runid INTEGER REFERENCES runs(id) ON DELETE CASCADE, number INTEGER, name TEXT, ok BOOLEAN, value REAL,
    bound REAL, side TEXT, tolerance REAL, unit TEXT, detail TEXT, PRIMARY KEY (runid, number)) WITHOUT ROWID;
CREATE TABLE rejections (
    runid INTEGER REFERENCES runs(id) ON DELETE CASCADE, reason TEXT, count INTEGER,
    PRIMARY KEY (runid, reason)) WITHOUT ROWID;
CREATE INDEX runs_of_experiment ON runs (experimentid);
"""

KERNELS_TABLE = """CREATE TABLE IF NOT EXISTS made_with (
    runid INTEGER PRIMARY KEY REFERENCES runs(id) ON DELETE CASCADE, kernels TEXT NOT NULL)"""
"""The kernels that made a run; a file may lack the table, or a run its row."""


def _statements() -> str:
    """Return what makes an empty results file, as one transaction."""
    words = ", ".join(f"('status', {number}, '{word}')" for number, word in enumerate(STATUS))
    return f"""
BEGIN IMMEDIATE;
{OMPL_TABLES}{OUR_TABLES}{KERNELS_TABLE};
INSERT INTO enums VALUES {words};
PRAGMA application_id = {APPLICATION_ID};
PRAGMA user_version = {FORMAT};
COMMIT;
"""


COST_COLUMNS = {term.key: term.key for term in TERMS if not term.of_all} | {"length_mm": "solution_length"}
"""The column of each cost of the needle; OMPL's benchmarks have one for the length."""


def _experiment_row(problem: Problem) -> dict[str, Any]:
    """Return a problem as a row in the table of OMPL's benchmarks."""
    return {
        "name": problem.case,
        "totaltime": 0.0,
        "timelimit": problem.time_s or 0.0,
        "memorylimit": 0.0,
        "version": f"lungaccess {software_version()}",
        "hostname": platform.node(),
        "date": datetime.datetime.now().isoformat(sep=" ", timespec="seconds"),
        "setup": json.dumps(problem.to_mapping() | {"devices": to_mapping(problem.system)}, sort_keys=True),
        "target": problem.target,
        "start": problem.start,
    }


def _problem_row(problem: Problem, experiment: int) -> dict[str, Any]:
    """Return the rest of a problem as a row."""
    x, y, z = problem.target_lps
    same = ("objective", "target", "origin", "start", "iterations", "time_s")
    return {
        "experimentid": experiment,
        "key": problem.key,
        "case_name": problem.case,
        "patient": problem.patient_name,
        "lung": problem.patient.key,
        "system": problem.system.name,
        "fissures_allowed": problem.system.fissures_allowed,
        "x_lps_mm": x,
        "y_lps_mm": y,
        "z_lps_mm": z,
        **{name: getattr(problem, name) for name in same},
    }


def _run_row(run: Run, answer: Answer, experiment: int, planner: int) -> dict[str, Any]:
    """Return a run as a row."""
    return {
        "experimentid": experiment,
        "plannerid": planner,
        "time": answer.time_s,
        "memory": answer.memory_mb,
        "iterations": answer.iterations,
        "solved": answer.solved,
        "correct_solution": answer.accepted,
        "status": answer.status,
        "cpu_time": answer.cpu_s,
        "first_solution_time": answer.improvements[0].time_s if answer.improvements else None,
        "solutions": len(answer.improvements),
        "seed": run.seed,
        "cost": answer.costs.get(run.problem.objective),
        **{column: answer.costs.get(key) for key, column in COST_COLUMNS.items()},
        "key": run.key,
    }


def _add_rest(connection: sqlite3.Connection, run: int, answer: Answer) -> None:
    """Store what a run ended with besides its row: outcome, plan, progress, findings and rejections."""
    outcome = (run, answer.outcome, answer.failed, answer.message, answer.advice)
    connection.execute("INSERT INTO outcomes VALUES (?, ?, ?, ?, ?)", outcome)
    connection.execute("INSERT INTO made_with VALUES (?, ?)", (run, answer.kernels))
    if answer.plan:
        connection.execute("INSERT INTO plans VALUES (?, ?, ?)", (run, answer.digest, answer.plan))
    points = [(run, each.time_s, each.cost, each.iteration) for each in answer.improvements]
    connection.executemany("INSERT INTO progress VALUES (?, ?, ?, ?)", points)
    names = ("name", "ok", "value", "limit", "side", "tolerance", "unit", "detail")
    findings = [(run, n, *(each[name] for name in names)) for n, each in enumerate(answer.findings, start=1)]
    connection.executemany(f"INSERT INTO findings VALUES (?, ?{', ?' * len(names)})", findings)
    counted = [(run, reason, count) for reason, count in answer.rejections.items()]
    connection.executemany("INSERT INTO rejections VALUES (?, ?, ?)", counted)
