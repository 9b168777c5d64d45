"""Benchmarks of new processes find what they import, wherever they are started."""

from __future__ import annotations

import importlib
import os
from pathlib import Path

import pytest

from benchmarks.fresh import ROOT, FreshProcess

for file in sorted((ROOT / "benchmarks").glob("bench_*.py")):
    importlib.import_module(f"benchmarks.{file.stem}")


def kinds() -> list[type[FreshProcess]]:
    return sorted(FreshProcess.__subclasses__(), key=lambda kind: kind.__module__)


def test_every_stage_has_a_benchmark_of_a_new_process() -> None:
    named = {kind.__module__.removeprefix("benchmarks.bench_") for kind in kinds()}
    assert {"kernels", "needle", "route", "scope", "segmentation", "tube"} <= named


@pytest.mark.slow
@pytest.mark.parametrize("kind", kinds(), ids=lambda kind: kind.__module__)
def test_a_new_process_finds_what_it_imports(
    kind: type[FreshProcess], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    benchmark = kind()
    benchmark.environment = dict(os.environ)
    lines = [line for line in kind.code.splitlines() if line.startswith(("import ", "from "))]
    assert lines
    benchmark.code = "\n".join(lines)
    benchmark.run()
