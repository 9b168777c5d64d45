"""Tubes that are not planar with errors of their rear ends: the shapes that they take instead."""

from __future__ import annotations

import numpy as np

from anatomy.typed import Float
from lungaccess.plans.plan import Plan
from lungaccess.risk.kernels import deviation as kernel
from stages.tube import Neighbourhood, pieces_of_arcs


def twisted_pieces(
    plan: Plan, insertion_mm: Float, relative_rad: Float, rotation_rad: Float
) -> tuple[Float, Float]:
    """Return the arcs of deviated tubes `(N, T, 4)`, and by how much too far their ends are rolled `(N,)`.

    The deviations are those of `Deviations`.

    Each distinct deviation is solved once.  Where tubes snap they have no length, so that they stay in the
    airway.
    """
    tube, tubes = plan.tube, plan.system.tubes
    turned, inserted = np.array(tube.rotations_rad(tubes)), np.array(tube.insertions_mm(tubes))
    lengths = np.array([each.length_mm for _name, each in tubes.named])
    joints, which = np.unique(np.hstack([insertion_mm, relative_rad]), axis=0, return_inverse=True)
    n = len(inserted)
    # An outer tube may not be ahead of one inside it.
    out = np.clip(inserted + joints[:, :n], 0.0, None)
    out = np.minimum(np.maximum.accumulate(out, axis=1), lengths)
    around = Neighbourhood.of(tubes.nested, inserted[::-1], turned[::-1] - tube.rotation_rad)
    shapes = []
    for lengths_mm, angles in zip(out, turned - tube.rotation_rad + joints[:, n:], strict=True):
        found = around.at(lengths_mm[::-1], angles[::-1]) if lengths_mm[-1] > 0.0 else None
        shapes.append(np.zeros((0, 4)) if found is None else np.asarray(found.arcs))
    beside = tube.clearance_loss_mm
    pieces = np.zeros((len(shapes), max(1, *(len(arcs) for arcs in shapes)), kernel.N_PIECE))
    rolled = np.zeros(len(shapes))
    for number, arcs in enumerate(shapes):
        kept = arcs[arcs[:, 0] > 0.0]
        laid = pieces_of_arcs(kept, tube.rotation_rad)
        pieces[number, : len(laid), [kernel.LENGTH, kernel.ROLL, kernel.CURVATURE]] = laid.T
        pieces[number, : len(laid), kernel.RADIUS] = kept[-len(laid) :, 3] + beside
        rolled[number] = laid[:, 1].sum() - tube.rotation_rad if len(laid) else 0.0
    pieces, rolled = pieces[which.ravel()], rolled[which.ravel()]
    pieces[:, 0, kernel.ROLL] += rotation_rad
    return pieces, rolled + rotation_rad
