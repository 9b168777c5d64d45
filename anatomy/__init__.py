"""The patient: images, masks, airway tree and clearances; read, segmented from a CT, or made from a seed."""

from __future__ import annotations

from typing import TYPE_CHECKING

from anatomy.facade import lazy_exports

if TYPE_CHECKING:
    from anatomy.airway_tree import AirwayTree as AirwayTree
    from anatomy.build import build_lung as build_lung
    from anatomy.errors import AnatomyError as AnatomyError
    from anatomy.errors import FileError as FileError
    from anatomy.errors import FrameError as FrameError
    from anatomy.errors import GridMismatchError as GridMismatchError
    from anatomy.errors import LungaccessError as LungaccessError
    from anatomy.errors import SettingsError as SettingsError
    from anatomy.fields import DistanceField as DistanceField
    from anatomy.grid import Grid as Grid
    from anatomy.grid import Volume as Volume
    from anatomy.io import load_patient as load_patient
    from anatomy.io import read_dicom as read_dicom
    from anatomy.io import read_mask as read_mask
    from anatomy.io import read_points as read_points
    from anatomy.io import read_pose as read_pose
    from anatomy.io import read_volume as read_volume
    from anatomy.io import write_volume as write_volume
    from anatomy.lung import Lung as Lung
    from anatomy.margins import Margins as Margins
    from anatomy.meshes import SurfaceMesh as SurfaceMesh
    from anatomy.patient import PatientImages as PatientImages
    from anatomy.phantom import Phantom as Phantom
    from anatomy.phantom import make_phantom as make_phantom
    from anatomy.phantom import write_phantom as write_phantom
    from anatomy.poses import pose as pose
    from anatomy.segmentation import Segmentation as Segmentation
    from anatomy.segmentation import SegmentationRequest as SegmentationRequest
    from anatomy.segmentation import read_ct as read_ct
    from anatomy.segmentation import segment as segment
    from anatomy.store import open_lung as open_lung
    from anatomy.structures import AIRWAY as AIRWAY
    from anatomy.structures import FISSURE as FISSURE
    from anatomy.structures import OUTSIDE as OUTSIDE
    from anatomy.structures import VESSEL as VESSEL
    from anatomy.tree import tree_from_graph as tree_from_graph
    from anatomy.tree import tree_from_mask as tree_from_mask
    from anatomy.tree_report import TreeReport as TreeReport

__getattr__, __dir__ = lazy_exports(__name__, __file__)
