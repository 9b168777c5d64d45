"""The rows of a results file, as SQL and values."""

import datetime
import json
import platform
import sqlite3
from typing import Any

from anatomy.base.settings import to_mapping
from lungaccess.plans.version import software_version
from lungaccess.running.study.answers import Answer
from lungaccess.running.study.runs import Problem, Run
from stages.needle import TERMS

COST_COLUMNS = {term.key: term.key for term in TERMS if not term.of_all} | {"length_mm": "solution_length"}
"""The column of each cost of the needle; OMPL's benchmarks have one for the length."""

Statement = tuple[str, tuple[Any, ...]]
"""SQL and its values."""


def _insert(table: str, row: dict[str, Any], how: str = "INSERT") -> Statement:
    places = ", ".join("?" * len(row))
    return f"{how} INTO {table} ({', '.join(row)}) VALUES ({places})", tuple(row.values())


def experiment_row(problem: Problem) -> Statement:
    """Return what stores a problem in the table of OMPL's benchmarks."""
    row = {
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
    return _insert("experiments", row)


def problem_row(problem: Problem, experiment: int) -> Statement:
    """Return what stores the rest of a problem."""
    x, y, z = problem.target_lps
    row = {
        "experimentid": experiment,
        "key": problem.key,
        "case_name": problem.case,
        "patient": problem.patient_name,
        "lung": problem.patient.key,
        "system": problem.system.name,
        "fissures_allowed": problem.system.fissures_allowed,
        "objective": problem.objective,
        "target": problem.target,
        "origin": problem.origin,
        "x_lps_mm": x,
        "y_lps_mm": y,
        "z_lps_mm": z,
        "start": problem.start,
        "iterations": problem.iterations,
        "time_s": problem.time_s,
    }
    return _insert("problems", row)


def run_row(run: Run, answer: Answer, experiment: int, planner: int) -> Statement:
    """Return what stores a run, unless one of the same key is there."""
    first = answer.improvements[0].time_s if answer.improvements else None
    row = {
        "experimentid": experiment,
        "plannerid": planner,
        "time": answer.time_s,
        "memory": answer.memory_mb,
        "iterations": answer.iterations,
        "solved": answer.solved,
        "correct_solution": answer.accepted,
        "status": answer.status,
        "cpu_time": answer.cpu_s,
        "first_solution_time": first,
        "solutions": len(answer.improvements),
        "seed": run.seed,
        "cost": answer.costs.get(run.problem.objective),
        **{column: answer.costs.get(key) for key, column in COST_COLUMNS.items()},
        "key": run.key,
    }
    return _insert("runs", row, "INSERT OR IGNORE")


def add_rest(connection: sqlite3.Connection, run: int, answer: Answer) -> None:
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
