"""Numbers as text: they survive, and what a type cannot hold is refused."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from anatomy.base.errors import AnatomyError
from lungaccess.showing.report import pack


@given(st.sampled_from(["u1", "u2", "i4"]), st.lists(st.integers(0, 255), max_size=60), st.booleans())
def test_whole_numbers_survive_packing(kind: str, values: list[int], wide: bool) -> None:
    scale = 257 if wide and kind != "u1" else 1
    array = np.array(values, dtype=np.int64).reshape(1, -1) * scale
    if kind == "i4":
        array = -array
    np.testing.assert_array_equal(pack.unpack(pack.pack(array, kind)), array)


@given(st.lists(st.floats(width=32, allow_nan=False, allow_infinity=False), max_size=40))
def test_single_precision_survives_packing(values: list[float]) -> None:
    np.testing.assert_array_equal(pack.unpack(pack.pack(values, "f4")), np.array(values, dtype=np.float32))


@pytest.mark.parametrize(
    ("values", "kind"), [([np.nan], "f4"), ([1e300], "f4"), ([256], "u1"), ([0.5], "i4")]
)
def test_what_a_type_cannot_hold_is_refused(values: list[float], kind: str) -> None:
    with np.errstate(over="ignore", invalid="ignore"), pytest.raises(AnatomyError):
        pack.pack(values, kind)
