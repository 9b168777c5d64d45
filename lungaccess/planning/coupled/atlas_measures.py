"""What can be measured of all deployments of an atlas: clearance at the tip, and stability of the tubes."""

from __future__ import annotations

import numpy as np

from anatomy.base.typed import Float
from lungaccess.planning.coupled.atlas import Atlas
from stages.tube import shapes_of


def tip_clearances_mm(atlas: Atlas) -> Float:
    """Return for each deployment `(E,)` by how much its tip is clearer of vessels and pleura than it must be.

    The value is a lower bound, mm, of the distance from the tip of the inner tube to vessels, pleura and,
    where they are obstacles, fissures, less the tube's radius and the margins.  Airways do not count: the
    tube has just pierced one.
    """
    names = ("vessel", "pleura", "fissure") if atlas.with_fissures else ("vessel", "pleura")
    tips = atlas.deployments.positions
    nearest = np.min([atlas.lung.fields[name].lower_bound_mm(tips) for name in names], axis=0)
    required = atlas.system.tubes.inner.radius_mm + atlas.system.margins.total_mm
    return np.asarray(nearest - required)


def tube_stability(atlas: Atlas) -> Float:
    """Return for each deployment `(E,)` the least determinant of its tubes in torsion: stable above 0.

    1 is that of tubes which do not wind each other up; see `stages.tube.mechanics.Equilibrium`.
    """
    return np.asarray(shapes_of(atlas.system.tubes).least_determinant[atlas.deployments.shape])
