"""A plan as a folder that 3D Slicer opens: curves, points, models, segmentation and a scene."""

from __future__ import annotations

from lungaccess.slicer.export import Exported, export_slicer

__all__ = ["Exported", "export_slicer"]
