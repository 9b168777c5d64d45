"""Strain of tubes on their way through a bent working channel, and how much they straighten a bent tip.

A tube of radius r and precurvature k* that is held at the curvature k has the strain r |k - k*| at its
surface, at worst r (|k| + |k*|), where the two bend to opposite sides.  Slots change it by a factor.  A place
of the channel `d` mm behind the scope's tip is passed by all of the tube from its tip to `d` mm behind what
is inserted beyond the scope.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.typed import Float
from stages.tube.device import ConcentricTubes


def channel_curvature_limit(tubes: ConcentricTubes, behind_tip_mm: ArrayLike) -> Float:
    """Return how bent the channel may be for the tubes to pass, (N,) float64 in 1/mm.

    All tubes may be inserted as far as the device allows.  Below 0, a tube cannot even be held straight.

    Parameters
    ----------
    behind_tip_mm : (N,) float64
        Places of the channel, counted from the scope's tip.
    """
    return np.array(
        [
            min(
                tube.most_bent_per_mm(tubes.max_strain, tubes.max_extension_mm + behind)
                for tube in tubes.nested
            )
            for behind in np.asarray(behind_tip_mm, dtype=np.float64).ravel().tolist()
        ]
    )


def transit_strain(tubes: ConcentricTubes, channel_pieces: ArrayLike, insertions_mm: ArrayLike) -> Float:
    """Return the largest strain of each tube on its way to its place, (n,) float64, the outermost first.

    That of a tube which the device lacks is 0.  It counts the channel, the straight part of it and of a
    straight outer tube, and where planar tubes are bent beyond it; `TubeShapes` has the strain of other tubes
    there.

    Parameters
    ----------
    channel_pieces : (P, 3) float64
        Length in mm, roll in rad and curvature in 1/mm of each arc of the channel, that at the scope's tip
        last; as `stages.scope.ScopeMotion.pieces`.
    insertions_mm : (n,) float64
        Of the tubes beyond the scope's tip, the outermost first; the last are those of the tubes there are.
    """
    pieces = np.asarray(channel_pieces, dtype=np.float64).reshape(-1, 3)
    far = np.append(np.cumsum(pieces[::-1, 0])[::-1], 0.0)
    bent = np.append(np.abs(pieces[:, 2]), tubes.overlap_curvature_per_mm if tubes.planar else 0.0)
    inserted = np.asarray(insertions_mm, dtype=np.float64)
    out = np.zeros(len(inserted))
    for n, (_name, tube) in enumerate(tubes.named, start=len(inserted) - len(tubes.named)):
        parts = tube.parts
        passes = parts.begin_mm <= float(inserted[n]) + far[:, None]
        # Beyond the scope the inner tube bends towards its precurvature, and the outer one with it.
        curvature = np.where(passes, bent[:, None], 0.0)
        if tube is tubes.inner:
            curvature[-1] = 0.0
        out[n] = ((curvature + parts.curvature_per_mm) * parts.strained_radius_mm).max()
    return out


def straightening(
    tubes: ConcentricTubes, insertions_mm: ArrayLike, bending_length_mm: float, section_stiffness_n_mm2: float
) -> float:
    """Return the bending stiffness of the tubes in a scope's bending section, as a share of the section's.

    Beam in beam: the section's own bending moment, which the handle sets, also bends what is inside.  With
    the share q the handle must be set to 1 + q times the bend that is wanted [Rucker2010, for tubes].
    Where the tubes are not equally stiff all along the section, their stiffest part there counts.

    Parameters
    ----------
    insertions_mm : (n,) float64
        As those of `transit_strain`.
    """
    total = 0.0
    inserted = np.asarray(insertions_mm, dtype=np.float64)[-len(tubes.nested) :]
    for (_name, tube), out_mm in zip(tubes.named, inserted, strict=True):
        parts = tube.parts
        inside = (parts.end_mm > out_mm) & (parts.begin_mm < out_mm + bending_length_mm)
        total += float(parts.stiffness_n_mm2[inside].max(initial=0.0))
    return total / section_stiffness_n_mm2
