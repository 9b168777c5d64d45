"""Directions of view: the three of radiology, and the plane that shows a curve best."""

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.records import frozen_record
from anatomy.base.typed import Float

LETTERS = (("R", "L"), ("A", "P"), ("I", "S"))


@frozen_record
class View:
    """A parallel projection onto the plane of two directions.

    Args:
        right, up ((3,) float64): Unit LPS directions that point to the right and to the top of the picture.
    """

    name: str
    right: Float
    up: Float

    @property
    def towards_viewer(self) -> Float:
        """Unit LPS direction out of the picture, `(3,)`."""
        return np.asarray(np.cross(self.right, self.up))

    def project(self, lps: ArrayLike) -> Float:
        """Map LPS points `(..., 3)` to picture coordinates `(..., 2)` in mm."""
        return np.asarray(np.asarray(lps, dtype=np.float64) @ np.stack([self.right, self.up], axis=1))

    def edge_letters(self) -> tuple[str, str, str, str]:
        """Return the anatomical directions of the left, right, bottom and top edge."""
        return letters(-self.right), letters(self.right), letters(-self.up), letters(self.up)


AXIAL = View(name="Axial, seen from the feet", right=np.array([1.0, 0, 0]), up=np.array([0, -1.0, 0]))
CORONAL = View(name="Coronal, seen from the front", right=np.array([1.0, 0, 0]), up=np.array([0, 0, 1.0]))
SAGITTAL = View(name="Sagittal, seen from the left", right=np.array([0, 1.0, 0]), up=np.array([0, 0, 1.0]))
STANDARD = (AXIAL, CORONAL, SAGITTAL)


def letters(direction: Float) -> str:
    """Name an LPS direction by its main anatomical letters, the strongest first.

    Examples:
        >>> letters(np.array([1.0, 0.0, 0.0]))
        'L'
        >>> letters(np.array([0.4, -0.9, 0.0]))
        'AL'
    """
    order = np.argsort(-np.abs(direction), kind="stable")
    strong = [axis for axis in order if abs(direction[axis]) > 0.35]
    return "".join(LETTERS[axis][int(direction[axis] > 0)] for axis in strong)


def plane_view(lps: Float, name: str) -> View:
    """Return the view straight onto the plane that fits the points `(N, 3)` best.

    Of the two sides and all rolls, the one nearest to a standard view is taken, so that the
    patient's left stays on the right side of the picture wherever it can.
    """
    centred = lps - lps.mean(axis=0)
    _, spread, axes = np.linalg.svd(centred, full_matrices=len(lps) < 3)
    if len(lps) < 3 or spread[1] < 0.02 * spread[0]:
        # Of a line, the standard view that foreshortens it least.
        beside = min(STANDARD, key=lambda standard: abs(float(axes[0] @ standard.towards_viewer)))
        normal = beside.towards_viewer - (beside.towards_viewer @ axes[0]) * axes[0]
        normal = normal / np.linalg.norm(normal)
    else:
        normal = axes[2]
    agreement = [float(normal @ view.towards_viewer) for view in STANDARD]
    nearest = int(np.argmax(np.abs(agreement)))
    normal = normal * np.sign(agreement[nearest])
    up = STANDARD[nearest].up - (STANDARD[nearest].up @ normal) * normal
    up = up / np.linalg.norm(up)
    return View(name=name, right=np.cross(up, normal), up=up)
