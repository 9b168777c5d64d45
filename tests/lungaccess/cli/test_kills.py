"""Commands that are killed again and again leave whole files and no process, and go on to the same end."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest

from tests.lungaccess.cli.killing import ended_at, outputs, started

SHARES = (0.1, 0.25, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
COMMANDS = {
    "reach": ("--spacing", "8", "--system", "ultrathin"),
    "tour": ("--system", "ultrathin"),
    "plan": (
        "--nodule", "--system", "ultrathin", "--processes", "2", "--iterations", "600", "--budget", "100000",
        "--no-pictures",
    ),
    "segment": (),
}  # fmt: skip
IN_THE_MAKING = {"segmentation.json", "plan.json"}
"""Are whole, but the one says less as long as images are missing, the other is the best plan so far."""
CLOCKED = {"summary.json", "cost_over_time.csv", "segmentation.json"}
"""Hold times, or what was made in which run."""


@pytest.mark.slow
@pytest.mark.parametrize("name", COMMANDS)
def test_a_killed_command_leaves_whole_files_and_goes_on(patient: Path, tmp_path: Path, name: str) -> None:
    def words(out: Path) -> list[str]:
        what = str(patient / "ct.nii.gz" if name == "segment" else patient)
        cache = [] if name == "segment" else ["--cache", str(tmp_path / "cache")]
        return [name, what, *COMMANDS[name], "--out", str(out), *cache, "-q"]

    def undisturbed(out: Path) -> tuple[int, dict[str, str]]:
        code = started(words(out)).wait()
        found = outputs(out)
        return code, {file: digest for file, digest in found.items() if file not in CLOCKED}

    undisturbed(tmp_path / "first")  # Compiles the kernels.
    before = _children_cpu_s()
    code, whole = undisturbed(tmp_path / "quiet")
    cpu_s, killed = _children_cpu_s() - before, 0
    for number, share in enumerate(SHARES):
        end = (signal.SIGKILL, signal.SIGTERM)[number % 2]
        killed += ended_at(words(tmp_path / "out"), share * cpu_s, end) is not None
        found = outputs(tmp_path / "out") if (tmp_path / "out").is_dir() else {}
        same = (set(found) & set(whole)) - IN_THE_MAKING
        assert {file: found[file] for file in same} == {file: whole[file] for file in same}
    assert killed >= len(SHARES) // 2
    assert undisturbed(tmp_path / "out") == (code, whole)


def _children_cpu_s() -> float:
    import resource

    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime
