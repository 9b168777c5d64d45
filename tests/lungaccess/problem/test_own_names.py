"""A changed preset needs a name of its own, before planning as in the check."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lungaccess as la
from anatomy.base.errors import SettingsError
from lungaccess.problem.system import preset_named, preset_text, shipped_names
from lungaccess.problem.target import Target

CHANGED = replace(
    la.load_system("ultrathin"), needle=replace(la.load_system("ultrathin").needle, max_curvature_per_mm=0.03)
)


@pytest.mark.parametrize("name", shipped_names())
@pytest.mark.parametrize("allowed", [None, True, False])
def test_a_preset_is_known_by_the_name_it_was_loaded_with(name: str, allowed: bool | None) -> None:
    loaded = la.load_system(name, fissures_allowed=allowed)
    assert preset_named(loaded.name) == loaded


def test_a_changed_preset_that_keeps_its_name_is_refused_before_planning(small_lung, tmp_path: Path) -> None:
    target = Target(lps_mm=np.zeros(3), origin="made")
    with pytest.raises(SettingsError, match="differs from it"):
        next(la.plan(small_lung, CHANGED, target, goal="default"))
    with pytest.raises(SettingsError, match="differs from it"):
        la.alternatives(small_lung, CHANGED, target, goal="default")
    file = tmp_path / "mine.toml"
    file.write_text(
        preset_text("ultrathin").replace("segmentation_margin_mm = 0.5", "segmentation_margin_mm = 0")
    )
    with pytest.raises(SettingsError, match="mine.toml is named 'ultrathin'"):
        la.load_system(file)
