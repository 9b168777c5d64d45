"""What cannot be a CT of the chest is refused, with a message that says why."""

from __future__ import annotations

import numpy as np
import pytest

from anatomy.base.errors import AnatomyError
from anatomy.grid import Grid, Volume
from anatomy.segmentation.input import has_thick_slices, require_chest_ct


def _chest(spacing_mm: tuple[float, float, float] = (2.5, 2.5, 2.5)) -> Volume:
    """A block of tissue in air with air inside, 160 mm on every side, as float32."""
    shape = tuple(round(160.0 / s) for s in spacing_mm)
    hu = np.full(shape, -1000.0, dtype=np.float32, order="F")
    i, j, k = (n // 8 for n in shape)
    hu[i:-i, j:-j, k:-k] = 40.0
    hu[2 * i : -2 * i, 2 * j : -2 * j, 2 * k : -2 * k] = -850.0
    return Volume(grid=Grid.from_spacing(shape, spacing_mm, (0, 0, 0)), array=hu)


def _changed(values: np.ndarray) -> Volume:
    return Volume(grid=_chest().grid, array=values)


def test_a_chest_passes_without_a_warning() -> None:
    assert require_chest_ct(_chest()) == ()


@pytest.mark.parametrize(
    ("values", "words"),
    [
        (np.zeros_like(_chest().array), "Every voxel of the image is 0"),
        (_chest().array + 1024.0, "lowest value of the image is 24.*offset.*missing"),
        (np.where(_chest().array < -900, np.nan, _chest().array), "not a number"),
        (np.where(_chest().array == 40.0, np.inf, _chest().array), "not a number"),
        (np.where(_chest().array < 0, -600.0, _chest().array), r"hardly any air"),
        (np.where(_chest().array == 40.0, 900.0, _chest().array), "hardly any soft tissue"),
        (_chest().array > 0, "type bool"),
    ],
)
def test_values_that_are_no_hounsfield_units_of_a_chest_are_refused(values: np.ndarray, words: str) -> None:
    with pytest.raises(AnatomyError, match=words):
        require_chest_ct(_changed(values))


def test_an_offset_is_missing_whatever_the_type() -> None:
    stored = (_chest().array + 1024).astype(np.uint16)
    with pytest.raises(AnatomyError, match=r"intercept"):
        require_chest_ct(_changed(stored))


def test_thick_slices_need_to_be_accepted_and_are_then_warned_of() -> None:
    ct = _chest((1.0, 1.0, 5.0))
    assert has_thick_slices(ct)
    with pytest.raises(AnatomyError, match=r"5\.0 mm apart.*--thick-slices"):
        require_chest_ct(ct)
    assert any("5.0 mm apart" in warning for warning in require_chest_ct(ct, thick_slices=True))
    assert not has_thick_slices(_chest((1.0, 1.0, 2.5)))


def test_no_flag_accepts_slices_that_show_no_lung_structure_at_all() -> None:
    with pytest.raises(AnatomyError, match="16.0 mm apart") as refused:
        require_chest_ct(_chest((1.0, 1.0, 16.0)), thick_slices=True)
    assert "--thick-slices" not in str(refused.value)


def test_a_piece_too_small_for_a_lung_is_refused() -> None:
    ct = _chest((1.0, 1.0, 1.0))
    slab = Volume(grid=ct.grid.crop((0, 0, 60), (160, 160, 100)), array=ct.array[:, :, 60:100])
    with pytest.raises(AnatomyError, match="160 x 160 x 40 mm"):
        require_chest_ct(slab)


def test_odd_scales_are_warned_of() -> None:
    values = np.array(_chest().array)
    values[0, 0, 0] = 20000.0
    assert any("20000 HU" in warning for warning in require_chest_ct(_changed(values)))
    assert any("voxel size" in warning for warning in require_chest_ct(_chest((2.9, 2.9, 2.9))))
