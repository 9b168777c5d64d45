"""Reading and writing of medical files; the only place where frames are flipped."""

from __future__ import annotations

from anatomy.io.dicom import SeriesInfo, list_series, read_dicom
from anatomy.io.files import atomic_write, require_writable_folder, sha256
from anatomy.io.frames import parse_point, read_points, read_pose
from anatomy.io.images import read_mask, read_volume, write_volume
from anatomy.io.patients import load_patient

__all__ = [
    "SeriesInfo",
    "atomic_write",
    "list_series",
    "load_patient",
    "parse_point",
    "read_dicom",
    "read_mask",
    "read_points",
    "read_pose",
    "read_volume",
    "require_writable_folder",
    "sha256",
    "write_volume",
]
