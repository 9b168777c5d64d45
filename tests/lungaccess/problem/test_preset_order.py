"""The order of systems follows their sizes, whatever their names are."""

from __future__ import annotations

from dataclasses import replace

import pytest

import lungaccess as la
from lungaccess.problem.preset_order import invasiveness, least_invasive_first, presets_by_invasiveness
from lungaccess.problem.system import System

DEFAULT = la.load_system("thin-scope")


def test_every_preset_has_its_place_by_the_hole_it_makes() -> None:
    ordered = presets_by_invasiveness()
    assert sorted(system.name for system in ordered) == sorted(la.preset_names())
    holes = [system.tubes.outermost.outer_diameter_mm for system in ordered]
    assert holes == sorted(holes)
    assert ordered[0].name == "lung-default" and ordered[-1].name == "therapeutic-scope"


MORE_INVASIVE = {
    "a fissure may be crossed": replace(DEFAULT, fissures_allowed=True),
    "a thicker outer tube": replace(
        DEFAULT, tubes=replace(DEFAULT.tubes, outer=replace(DEFAULT.tubes.outer, outer_diameter_mm=1.95))
    ),
    "a thicker needle": replace(DEFAULT, needle=replace(DEFAULT.needle, diameter_mm=1.1)),
    "a thicker scope": replace(DEFAULT, scope=replace(DEFAULT.scope, outer_diameter_mm=4.5)),
    "a tighter needle": replace(DEFAULT, needle=replace(DEFAULT.needle, max_curvature_per_mm=0.02)),
}


@pytest.mark.parametrize("worse", MORE_INVASIVE.values(), ids=MORE_INVASIVE.keys())
def test_each_size_counts(worse: System) -> None:
    named = replace(worse, name="a name that comes first")
    assert invasiveness(DEFAULT) < invasiveness(named)
    assert least_invasive_first([named, DEFAULT]) == (DEFAULT, named)


def test_a_fissure_is_worse_than_any_size() -> None:
    thin = replace(la.load_system("ultrathin"), fissures_allowed=True)
    assert least_invasive_first([thin, la.load_system("therapeutic-scope")])[-1] is thin
