"""The patient: images, masks, airway tree and clearances; read, segmented from a CT, or made from a seed."""

from typing import TYPE_CHECKING

from anatomy.base.facade import lazy_exports

if TYPE_CHECKING:
    from anatomy.airway_tree import AirwayTree, TreeReport
    from anatomy.base.errors import (
        AnatomyError,
        FileError,
        FrameError,
        GridMismatchError,
        LungaccessError,
        SettingsError,
    )
    from anatomy.build import build_lung
    from anatomy.fields import DistanceField
    from anatomy.grid import Grid, Volume
    from anatomy.io import (
        load_patient,
        read_dicom,
        read_mask,
        read_points,
        read_pose,
        read_volume,
        write_volume,
    )
    from anatomy.lung import Lung
    from anatomy.margins import Margins
    from anatomy.meshes import SurfaceMesh
    from anatomy.patient import PatientImages
    from anatomy.phantom import Phantom, make_phantom, write_phantom
    from anatomy.poses import pose
    from anatomy.segmentation import Segmentation, SegmentationRequest, read_ct, segment
    from anatomy.store import open_lung
    from anatomy.structures import AIRWAY, FISSURE, OUTSIDE, VESSEL
    from anatomy.tree import tree_from_graph, tree_from_mask

__getattr__, __dir__ = lazy_exports(__name__, __file__)
