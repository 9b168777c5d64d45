"""Reading and writing of medical files; the only place where frames are flipped."""

from typing import TYPE_CHECKING

from anatomy.base.facade import lazy_exports

if TYPE_CHECKING:
    from anatomy.io.dicom import SeriesInfo, list_series, read_dicom
    from anatomy.io.frames import parse_point, read_points, read_pose
    from anatomy.io.images import read_mask, read_volume, write_volume
    from anatomy.io.patients import load_patient

__getattr__, __dir__ = lazy_exports(__name__, __file__)
