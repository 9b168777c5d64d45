"""A synthetic patient with known truth: airways, vessels, lobes, nodules and CT from a seed."""

from __future__ import annotations

from anatomy.phantom.branching import Centerlines
from anatomy.phantom.chest import LOBES
from anatomy.phantom.files import write_phantom
from anatomy.phantom.nodules import Nodule
from anatomy.phantom.patient import Phantom, phantom
from anatomy.phantom.rasterize import LABELS

__all__ = ["LABELS", "LOBES", "Centerlines", "Nodule", "Phantom", "phantom", "write_phantom"]
