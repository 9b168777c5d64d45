"""The growth study: exponents of known laws, and that asv measures every workload."""

from __future__ import annotations

import pytest

from benchmarks import bench_growth
from benchmarks.workloads import WORKLOADS
from experiments.growth import Growth, draw


def of_law(name: str, exponent: float, factor: float) -> Growth:
    amounts = tuple(WORKLOADS[name].amount(size) for size in WORKLOADS[name].sizes)
    cpu_s = tuple(factor * amount**exponent for amount in amounts)
    return Growth(name=name, amounts=amounts, cpu_s=cpu_s, peak_mb=(1.0,) * len(amounts))


@pytest.mark.parametrize("exponent", [0.5, 1.0, 2.0])
def test_the_exponent_of_a_power_law_is_found(exponent: float) -> None:
    growth = of_law("build-index", exponent, 1e-2)
    assert growth.fitted()[0] == pytest.approx(exponent)
    assert growth.last_slope() == pytest.approx(exponent)


def test_a_law_that_bends_upwards_shows_in_the_last_slope() -> None:
    growth = of_law("build-index", 1.0, 1e-2)
    bent = Growth(
        name=growth.name, amounts=growth.amounts, cpu_s=(*growth.cpu_s[:-1], 10.0 * growth.cpu_s[-1]),
        peak_mb=growth.peak_mb,
    )  # fmt: skip
    assert bent.last_slope() == pytest.approx(2.0)
    assert bent.fitted()[0] > 1.2


def test_what_takes_no_time_is_left_out_of_the_fit() -> None:
    growth = of_law("distance-field", 1.0, 1e-8)
    overhead = (5e-4, 5e-4, *growth.cpu_s[2:])
    slow_start = Growth(name=growth.name, amounts=growth.amounts, cpu_s=overhead, peak_mb=growth.peak_mb)
    assert slow_start.fitted()[0] == pytest.approx(1.0)


def test_asv_measures_every_workload_at_every_size() -> None:
    classes = [value for value in vars(bench_growth).values() if getattr(value, "name", "") in WORKLOADS]
    assert sorted(each.name for each in classes) == sorted(WORKLOADS)
    for each in classes:
        assert each.params == WORKLOADS[each.name].sizes


@pytest.mark.slow
def test_the_work_of_the_least_size_can_be_done() -> None:
    for name in ("build-index", "query-index", "shortest-tour", "tube-mechanics", "distance-field"):
        assert WORKLOADS[name].prepare(WORKLOADS[name].sizes[0])() is not None


def test_the_figure_has_a_panel_for_all_that_grows() -> None:
    found = [of_law(name, 1.0, 1e-6) for name in WORKLOADS]
    figure = draw(found)
    assert [axes.get_xlabel() for axes in figure.axes] == list(
        dict.fromkeys(w.grows for w in WORKLOADS.values())
    )
