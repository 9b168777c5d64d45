"""Which presets an explanation tries, in which order, within which time, and what it then says of them."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numba.core.compiler_lock import global_compiler_lock

import lungaccess as la
from anatomy.base import kernel_clock
from anatomy.lung import Lung
from lungaccess.judging.answering import Attempt
from lungaccess.judging.explanation import Explanation, explain, explain_no_plan, explanation_record, sections
from lungaccess.problem.preset_order import presets_by_invasiveness
from lungaccess.problem.system import System
from tests.lungaccess.points import FAR_TARGET

OTHER_PARTS = (
    "_what_blocks", "_starts", "_through_fissures", "_neighbour", "_needle_changes", "_shares",
    "_scope_changes", "_proof",
)  # fmt: skip
ATLAS_S = 3.0
OWN = la.load_system("therapeutic-scope")
PRESETS = [system.name for system in presets_by_invasiveness()]
OTHERS = [name for name in PRESETS if name != OWN.name]
FAILURE = la.NoPlan("No plan", reasons={})
Explained = Callable[..., Explanation]


@dataclass(frozen=True)
class FakeAtlas:
    """What is passed on unseen."""

    system: System
    motions: Any = field(default_factory=lambda: SimpleNamespace(tips=np.zeros((0, 9))))


class FakeTime:
    """Processor time that passes when the test says so, and a clock of the wall that is always far ahead."""

    def __init__(self) -> None:
        self.cpu_s = self.wall_s = 0.0

    def perf_counter(self) -> float:
        self.wall_s += 1000.0
        return self.wall_s

    def process_time(self) -> float:
        return self.cpu_s


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> FakeTime:
    made = FakeTime()
    monkeypatch.setattr(kernel_clock, "time", made)
    return made


@pytest.fixture
def explained(small_lung: Lung, clock: FakeTime, monkeypatch: pytest.MonkeyPatch) -> Explained:
    """Explain a failure: every atlas costs `ATLAS_S`, every other part nothing, and those named reach it."""
    for name in OTHER_PARTS:
        monkeypatch.setattr(explain.Explainer, name, lambda _self: None)
    monkeypatch.setattr(explain.coupled, "direct_candidates", lambda *_: None)
    monkeypatch.setattr(explain, "run", lambda *_, **__: iter(()))
    accepted: Any = SimpleNamespace(accepted=True)

    def explained_with(
        own: System = OWN,
        kept: Collection[str] = (),
        reach: Collection[str] = (),
        time_s: float | None = None,
        compiling_s: float = 0.0,
        tried: list[str] | None = None,
        failure: la.NoPlan = FAILURE,
    ) -> Explanation:
        def first_attempt(_plans: Any, system: System, _checker: Any) -> Attempt:
            if tried is not None:
                tried.append(system.name)
            if system.name in reach:
                return Attempt(system=system, report=accepted)
            return Attempt(system=system, failure=FAILURE)

        def atlas_of(system: System, progress: Callable[[float], None]) -> Any:
            with global_compiler_lock:
                clock.cpu_s += compiling_s
            clock.cpu_s += ATLAS_S
            progress(1.0)
            return FakeAtlas(system)

        monkeypatch.setattr(explain, "first_attempt", first_attempt)
        return explain_no_plan(
            small_lung, own, la.resolve_target(small_lung, FAR_TARGET), failure, atlas=FakeAtlas(own),  # type: ignore[arg-type]
            time_s=time_s, atlas_of=atlas_of, is_kept=lambda system: system.name in kept,
        )  # fmt: skip

    return explained_with


def test_without_any_atlas_the_least_invasive_comes_first(explained: Explained) -> None:
    tried: list[str] = []
    explained(tried=tried)
    assert tried == OTHERS


def test_presets_whose_atlas_is_kept_come_first_and_keep_their_order(explained: Explained) -> None:
    tried: list[str] = []
    made = explained(kept=("flexure-needle", "tubes-only"), tried=tried)
    assert tried[:2] == ["tubes-only", "flexure-needle"]
    assert tried[2:] == ["lung-default", "ultrathin", "stylet-needle", "thin-scope"]
    assert list(made.presets) == OTHERS, "what is said keeps the order of invasiveness"
    names = [part.name for part in made.parts]
    assert names.index("preset flexure-needle") < names.index("change of the needle")
    assert names.index("change of the needle") < names.index("preset ultrathin")


def test_presets_that_share_the_atlas_come_before_those_whose_atlas_is_kept(explained: Explained) -> None:
    tried: list[str] = []
    own = replace(la.load_system("flexure-needle"), name="mine")
    explained(own=own, kept=("ultrathin",), tried=tried)
    assert tried[:3] == ["thin-scope", "flexure-needle", "ultrathin"]


@pytest.mark.parametrize(
    ("kept", "first"), [((), "lung-default"), (("thin-scope",), "thin-scope"), (PRESETS, "lung-default")]
)
def test_one_preset_is_tried_without_any_time(
    explained: Explained, clock: FakeTime, kept: Collection[str], first: str
) -> None:
    """Its atlas alone takes longer than there is; the parts before it were not begun."""
    tried: list[str] = []
    made = explained(kept=kept, time_s=-1.0, tried=tried)
    assert tried == [first]
    assert [part.name for part in made.parts if part.outcome == "done"] == [f"preset {first}"]
    assert made.time_s == pytest.approx(ATLAS_S)


def test_an_atlas_that_takes_too_long_is_not_waited_for_twice(explained: Explained) -> None:
    tried: list[str] = []
    made = explained(time_s=5.0, tried=tried)
    assert tried == ["lung-default"], "the second atlas ends at 6 s"
    assert made.time_s == pytest.approx(2 * ATLAS_S)


@pytest.mark.parametrize("compiling_s", [0.0, 1e4])
def test_compiling_and_waiting_take_no_time(explained: Explained, compiling_s: float) -> None:
    """The same failure is explained equally on a fresh installation, and on a busy machine."""
    made = explained(time_s=19.0, compiling_s=compiling_s)
    assert not made.untried and not made.not_tried
    assert made.time_s == pytest.approx(6 * ATLAS_S)
    assert explanation_record(made)["explain_cpu_s"] == made.time_s


def test_the_least_invasive_is_named_where_all_less_invasive_were_tried(explained: Explained) -> None:
    reach = ("thin-scope", "flexure-needle")
    least = "thin-scope would reach it, the least invasive other preset with a plan"
    assert explained(reach=reach).headline.endswith(f"; {least} (6 of 6 other presets tried)")
    few = explained(reach=reach, time_s=5.5 * ATLAS_S).headline
    assert few.endswith(f"; {least} (5 of 6 other presets tried; not tried: flexure-needle)")


def test_none_is_called_least_invasive_where_a_lesser_one_was_not_tried(explained: Explained) -> None:
    made = explained(kept=("thin-scope",), reach=PRESETS, time_s=1.5 * ATLAS_S)
    assert made.headline.endswith(
        "; thin-scope would reach it (1 of 6 other presets tried; not tried: lung-default (less invasive), "
        "ultrathin (less invasive), stylet-needle (less invasive), tubes-only (less invasive), "
        "flexure-needle)"
    )


def test_where_none_reaches_it_the_untried_ones_are_named(explained: Explained) -> None:
    assert explained().headline.endswith(
        "; with no other preset was a plan found (6 of 6 other presets tried)"
    )
    made = explained(time_s=1.5 * ATLAS_S)
    assert made.headline.endswith(
        "; no plan with lung-default (1 of 6 other presets tried; not tried: ultrathin, stylet-needle, "
        "tubes-only, thin-scope, flexure-needle)"
    )
    (table,) = (each for each in sections(made) if each.title.startswith("Other presets"))
    assert table.title == "Other presets, the least invasive first: 1 of 6 tried"
    assert [row[0] for row in table.rows] == OTHERS
    assert [each["tried"] for each in explanation_record(made)["presets"]] == [True] + 5 * [False]


def test_what_failed_when_a_system_was_chosen_is_not_tried_again(explained: Explained) -> None:
    tried: list[str] = []
    failure = la.NoPlan("None", reasons={}, attempts=dict.fromkeys(PRESETS[:4], "no plan: it is too thick"))
    made = explained(own=la.load_system(PRESETS[0]), failure=failure, tried=tried)
    assert tried == PRESETS[4:] == list(made.presets)
    assert made.headline == f"No plan found with any of 4 systems; with {PRESETS[0]}: it is too thick"
