"""From a CT of the chest to the masks and the cost map of a patient."""

from typing import TYPE_CHECKING

from anatomy.base.facade import lazy_exports

if TYPE_CHECKING:
    from anatomy.segmentation.pipeline import Segmentation, read_ct, segment
    from anatomy.segmentation.request import Given, SegmentationRequest

__getattr__, __dir__ = lazy_exports(__name__, __file__)
