"""The tables of a results file: those of OMPL's benchmarks, and our own beside them.

`experiments`, `plannerConfigs`, `enums`, `runs` and `progress` have the names and columns that
`ompl.tools.readBenchmarkLog` makes of a log, so that Planner Arena and SQL written for those databases read
them.  An experiment is one problem: a target of a case.
"""

from __future__ import annotations

from lungaccess.running.study.answers import STATUS

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


def statements() -> str:
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
