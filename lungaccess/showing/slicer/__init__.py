"""A plan as a folder that 3D Slicer opens: curves, points, models, segmentation and a scene; and back."""

from lungaccess.showing.slicer.edited import EditedCurve, check_curve
from lungaccess.showing.slicer.export import Exported, export_slicer

__all__ = ["EditedCurve", "Exported", "check_curve", "export_slicer"]
