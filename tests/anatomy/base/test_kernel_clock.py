"""The clock stands still while a kernel is compiled, and says which one it is."""

from __future__ import annotations

import time
from types import SimpleNamespace

import numba
import pytest
from numba.core.compiler_lock import global_compiler_lock

from anatomy.base import kernel_clock
from anatomy.base.kernel_clock import watching_compilations, working_cpu_s, working_s


@numba.njit
def inner_of_the_test(x):
    return 2.0 * x + 1.0


def test_compiling_takes_no_working_time() -> None:
    @numba.njit
    def outer_of_the_test(x):
        return inner_of_the_test(x) ** 2

    told: list[str | None] = []
    began, wall = working_s(), time.perf_counter()
    with watching_compilations(told.append):
        assert outer_of_the_test(1.0) == 9.0
    worked, passed = working_s() - began, time.perf_counter() - wall
    assert told[0] == "outer_of_the_test" and told[-1] is None and "inner_of_the_test" in told
    assert 0.0 <= worked < 0.2 * passed
    with watching_compilations(lambda _: pytest.fail("it is compiled already")):
        outer_of_the_test(2.0)


def test_work_takes_working_time() -> None:
    began, wall = working_s(), time.perf_counter()
    time.sleep(0.02)
    assert working_s() - began == pytest.approx(time.perf_counter() - wall, abs=0.01)


def test_no_clock_counts_what_passes_under_the_lock_of_the_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    """One interval within another counts once, as a kernel within a kernel does."""
    passed = {"wall": 0.0, "cpu": 0.0}
    fake = SimpleNamespace(perf_counter=lambda: passed["wall"], process_time=lambda: passed["cpu"])
    monkeypatch.setattr(kernel_clock, "time", fake)
    began, began_cpu = working_s(), working_cpu_s()
    with global_compiler_lock, global_compiler_lock:
        passed |= {"wall": 512.0, "cpu": 256.0}
    passed |= {"wall": 520.0, "cpu": 257.0}
    assert working_s() - began == pytest.approx(8.0)
    assert working_cpu_s() - began_cpu == pytest.approx(1.0)
