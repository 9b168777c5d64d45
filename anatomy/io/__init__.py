"""Reading and writing of medical files; the only place where frames are flipped."""

from __future__ import annotations

from typing import TYPE_CHECKING

from anatomy.facade import lazy_exports

if TYPE_CHECKING:
    from anatomy.io.dicom import SeriesInfo as SeriesInfo
    from anatomy.io.dicom import list_series as list_series
    from anatomy.io.dicom import read_dicom as read_dicom
    from anatomy.io.files import atomic_write as atomic_write
    from anatomy.io.files import require_writable_folder as require_writable_folder
    from anatomy.io.files import sha256 as sha256
    from anatomy.io.frames import parse_point as parse_point
    from anatomy.io.frames import read_points as read_points
    from anatomy.io.frames import read_pose as read_pose
    from anatomy.io.images import read_mask as read_mask
    from anatomy.io.images import read_volume as read_volume
    from anatomy.io.images import write_volume as write_volume
    from anatomy.io.patients import load_patient as load_patient

__getattr__, __dir__ = lazy_exports(__name__, __file__)
