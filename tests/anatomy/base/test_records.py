"""Records as plain values and arrays, and back."""

from __future__ import annotations

import json
from collections.abc import Mapping

import numpy as np
import pytest

from anatomy.base.records import frozen_record, plain_values, record_from
from anatomy.base.typed import Float, Int


@frozen_record
class Part:
    name: str
    points: Float


@frozen_record
class Whole:
    first: Part
    maybe: Part | None
    others: tuple[Part, ...]
    poses: tuple[Float, ...]
    shape: tuple[int, int]
    by_name: Mapping[str, Part]
    counts: Int


def part(name: str, count: int) -> Part:
    return Part(name=name, points=np.arange(3.0 * count).reshape(count, 3) / 7.0)


@pytest.mark.parametrize("maybe", [None, part("maybe", 1)])
def test_a_record_comes_back_from_json_and_arrays(maybe: Part | None) -> None:
    whole = Whole(
        first=part("first", 0), maybe=maybe, others=(part("a", 1), part("b", 2)), poses=(np.eye(4),),
        shape=(2, 3), by_name={"c": part("c", 3)}, counts=np.array([1, 2]),
    )  # fmt: skip
    arrays: dict[str, np.ndarray] = {}
    plain = json.loads(json.dumps(plain_values(whole, "", arrays)))
    assert {"first.points", "others.1.points", "poses.0", "by_name.c.points", "counts"} <= set(arrays)
    again = record_from(Whole, plain, arrays)
    assert isinstance(again, Whole) and again.shape == (2, 3) and again.first.points.shape == (0, 3)
    assert (again.maybe is None) == (maybe is None) and again.others[1].name == "b"
    other: dict[str, np.ndarray] = {}
    assert plain_values(again, "", other) == plain_values(whole, "", {})
    assert all(np.array_equal(other[name], array) for name, array in arrays.items())
