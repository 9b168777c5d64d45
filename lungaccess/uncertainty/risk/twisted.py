"""Tubes that are not planar with errors of their rear ends: the shapes that they take instead."""

import numpy as np

from anatomy.base.typed import Float, Int
from lungaccess.plans.plan import Plan
from lungaccess.uncertainty.risk.kernels import deviation as kernel
from stages.tube import Neighbourhood, pieces_of_arcs


def twisted_shapes(plan: Plan, insertion_mm: Float, relative_rad: Float) -> tuple[Float, Float, Int]:
    """Return the shapes that deviated tubes take, and which of them each deviation has.

    The deviations are those of `Deviations`.

    Each distinct deviation is solved once.  No tube goes farther than the device can: not behind the scope
    tip, nor behind one around it, nor so far that its rear end passes that of one around it.  Where tubes
    snap they have no length, so that they stay in the airway.

    Returns:
        - shapes ((S, T, 4) float64) - As the first pieces of a chain, see
          `lungaccess.uncertainty.risk.kernels.deviation`.
        - rolled_rad ((S,) float64) - By how much too far the end of the tubes is rolled.
        - which ((N,) int64)
    """
    tube, tubes = plan.tube, plan.system.tubes
    turned, inserted = np.array(tube.rotations_rad(tubes)), np.array(tube.insertions_mm(tubes))
    lengths = np.array([each.length_mm for _name, each in tubes.named])
    n = len(inserted)
    out = _within_limits(inserted + insertion_mm, lengths, tubes.max_extension_mm)
    joints, which = np.unique(np.hstack([out, relative_rad]), axis=0, return_inverse=True)
    around = Neighbourhood.of(
        tubes.nested, inserted[::-1], turned[::-1] - tube.rotation_rad, needle=tubes.needle_shaft
    )
    shapes = []
    for each in joints:
        lengths_mm, angles = each[:n], turned - tube.rotation_rad + each[n:]
        found = around.at(lengths_mm[::-1], angles[::-1]) if lengths_mm[-1] > 0.0 else None
        shapes.append(np.zeros((0, 4)) if found is None else np.asarray(found.arcs))
    pieces = np.zeros((len(shapes), max(1, *(len(arcs) for arcs in shapes)), kernel.N_PIECE))
    rolled = np.zeros(len(shapes))
    for number, arcs in enumerate(shapes):
        kept = arcs[arcs[:, 0] > 0.0]
        laid = pieces_of_arcs(kept, tube.rotation_rad)
        pieces[number, : len(laid), [kernel.LENGTH, kernel.ROLL, kernel.CURVATURE]] = laid.T
        pieces[number, : len(laid), kernel.RADIUS] = kept[-len(laid) :, 3] + tube.clearance_loss_mm
        rolled[number] = laid[:, 1].sum() - tube.rotation_rad if len(laid) else 0.0
    return pieces, rolled, which.ravel()


def _within_limits(out_mm: Float, lengths_mm: Float, most_mm: float) -> Float:
    """Return insertions `(N, n)`, the outermost first, as the device can have them."""
    kept = np.clip(out_mm, 0.0, np.minimum(lengths_mm, most_mm))
    kept = np.maximum.accumulate(kept, axis=1)
    ahead = np.concatenate([[np.inf], np.diff(lengths_mm)])
    for tube in range(1, kept.shape[1]):
        kept[:, tube] = np.minimum(kept[:, tube], kept[:, tube - 1] + ahead[tube])
    return kept
