"""How much tubes and needle straighten a scope's bent tip."""

import numpy as np
from numpy.typing import ArrayLike

from stages.tube.device import ConcentricTubes, Tube


def straightening(
    tubes: ConcentricTubes,
    insertions_mm: ArrayLike,
    bending_length_mm: float,
    section_stiffness_n_mm2: float,
    *,
    needle: Tube | None = None,
    needle_out_mm: float = 0.0,
) -> float:
    """Return the bending stiffness of what lies in a scope's bending section, as a share of the section's.

    Beam in beam: the section's own bending moment, which the handle sets, also bends what is inside.  With
    the share q the handle must be set to 1 + q times the bend that is wanted [Rucker2010, for tubes].
    Where the tubes are not equally stiff all along the section, their stiffest part there counts, and of the
    needle the stiffest that passes the section on the whole of its way.

    Args:
        insertions_mm ((n,) float64): Of the tubes beyond the scope's tip, the outermost first; the last are
            those of the tubes there are.
        needle_out_mm: How far the needle goes beyond the tip of the inner tube.
    """
    total = 0.0
    inserted = np.asarray(insertions_mm, dtype=np.float64)[-len(tubes.nested) :]
    for (_name, tube), out_mm in zip(tubes.named, inserted, strict=True):
        parts = tube.parts
        inside = (parts.end_mm > out_mm) & (parts.begin_mm < out_mm + bending_length_mm)
        total += float(parts.stiffness_n_mm2[inside].max(initial=0.0))
    if needle is not None:
        passing_mm = float(inserted[-1]) + needle_out_mm + bending_length_mm
        total += float(needle.parts.stiffness_n_mm2[needle.parts.begin_mm < passing_mm].max())
    return total / section_stiffness_n_mm2
