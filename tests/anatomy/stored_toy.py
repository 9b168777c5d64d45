"""The toy in a cache."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields as dataclass_fields
from dataclasses import is_dataclass
from typing import Any

import numpy as np

from anatomy.build import lung_key
from anatomy.patient import PatientImages
from anatomy.store import folder_name

SOURCES = {"airway.nii.gz": "a" * 64, "lung.nii.gz": "b" * 64}
KEY = lung_key(SOURCES)
FOLDER = folder_name(KEY)


def no_reading() -> PatientImages:
    raise AssertionError("the images were read although the lung was stored")


def require_same(a: Any, b: Any, where: str = "lung") -> None:
    """Compare dataclasses, arrays, tuples and mappings to the last bit."""
    if is_dataclass(a):
        assert type(a) is type(b), where
        for field in dataclass_fields(a):
            if field.name == "folder":  # Where a lung is stored is no part of what it is.
                continue
            require_same(getattr(a, field.name), getattr(b, field.name), f"{where}.{field.name}")
    elif isinstance(a, np.ndarray):
        assert isinstance(b, np.ndarray) and a.dtype == b.dtype, where
        np.testing.assert_array_equal(a, b, err_msg=where)
        assert a.flags.f_contiguous == b.flags.f_contiguous, where
    elif isinstance(a, Mapping):
        assert set(a) == set(b), where
        for key in a:
            require_same(a[key], b[key], f"{where}[{key}]")
    elif isinstance(a, tuple):
        assert isinstance(b, tuple) and len(a) == len(b), where
        for n, (x, y) in enumerate(zip(a, b, strict=True)):
            require_same(x, y, f"{where}[{n}]")
    else:
        assert a == b and type(a) is type(b), where
