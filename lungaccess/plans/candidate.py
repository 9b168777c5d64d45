"""A candidate for a plan: the choices of all three stages, from which everything else follows."""

import numpy as np
from numpy.typing import ArrayLike

from anatomy import poses
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from anatomy.lung import Lung
from lungaccess.plans.curves import SHORTEST_MM, pieces_beyond, radii_at
from lungaccess.problem.system import System
from stages.needle import LENGTH, ArcPath, InTissue
from stages.scope import Bronchoscope, ScopeTip, TipRow, in_tip_region, prover_of
from stages.tube import Deployment, pieces_of_arcs

BAND_STEP_MM = 0.05
"""Spacing of the places at which the band of a fissure is looked up: its voxels differ in chance."""


@frozen_record
class Candidate:
    """The choices that make a plan.

    Args:
        path: What the costs are of: the needle from the tip of the tubes to the target; without a needle, the
            tubes from where they leave the lumen to their tip, which is at the target.
    """

    tip: ScopeTip
    deployment: Deployment
    path: ArcPath


def tubes_in_tissue(lps_from_scope_tip: Float, deployment: Deployment) -> ArcPath:
    """Return the tubes of a deployment, from where they leave the lumen to their tip, as a path."""
    return _tubes_beyond(lps_from_scope_tip, deployment, deployment.exit_mm)


def parts_in_tissue(
    system: System, lps_from_scope_tip: Float, deployment: Deployment, path: ArcPath
) -> list[InTissue]:
    """Return all of a candidate that lies in tissue: its tubes from the wall on, and the path of the needle.

    The tubes count where they have left the wall that they pierce.  Each part has the width of one device:
    of tubes in each other that of the outermost.
    """
    begin_mm, parts = deployment.exit_mm + deployment.wall_run_mm, []
    if begin_mm < deployment.inner_mm - SHORTEST_MM:
        tubes = _tubes_beyond(lps_from_scope_tip, deployment, begin_mm)
        ends_mm = begin_mm + np.cumsum(tubes.arcs[:, LENGTH])
        middles_mm = ends_mm - 0.5 * tubes.arcs[:, LENGTH]
        radii = radii_at(system.tubes, deployment.shape.insertions_mm[::-1].tolist(), middles_mm)
        for frame, arc, radius in zip(tubes.frames(), tubes.arcs, radii.tolist(), strict=False):
            parts.append(InTissue(ArcPath(lps_from_start=frame, arcs=arc), 2.0 * radius))
    if system.needle is not None:
        parts.append(InTissue(path, system.needle.diameter_mm))
    return parts


def fissure_chance(
    system: System, lung: Lung, lps_from_scope_tip: Float, deployment: Deployment, path: ArcPath
) -> float | None:
    """Return the chance that the axes of a candidate cross a fissure; None where that is not known."""
    if lung.fissure_band is None:
        return None
    parts = [path] if system.needle is None else [tubes_in_tissue(lps_from_scope_tip, deployment), path]
    return lung.fissure_chance(np.concatenate([part.sample(BAND_STEP_MM)[0] for part in parts]))


def _tubes_beyond(lps_from_scope_tip: Float, deployment: Deployment, begin_mm: float) -> ArcPath:
    pieces = pieces_of_arcs(deployment.shape.arcs, deployment.rotation_rad)
    start, arcs = pieces_beyond(lps_from_scope_tip, pieces, begin_mm)
    return ArcPath(lps_from_start=start, arcs=arcs)


def with_tool_in_place(system: System, path: ArcPath) -> ArcPath:
    """Return a path to the target that goes on until the middle of the system's tool is there.

    The last arc goes on as it bends: the tool then lies about the place where the path met the target.
    """
    if system.tool is None:
        return path
    arcs = path.arcs.copy()
    arcs[-1:, LENGTH] += system.tool.beyond_mm
    return ArcPath(lps_from_start=path.lps_from_start, arcs=arcs)


def wall_in_path_mm(system: System, deployment: Deployment) -> float:
    """Return how much of a candidate's path lies in the wall that is pierced: a needle begins beyond it."""
    return deployment.wall_run_mm if system.needle is None else 0.0


class TipRows:
    """Moves tips of a scope along the motions to them."""

    def __init__(self, lung: Lung, scope: Bronchoscope) -> None:
        self._tree = lung.tree
        self._prover = prover_of(lung, scope)

    def along(self, tip: ScopeTip, shifts_mm: ArrayLike) -> TipRow:
        """Return the tips whose base stops so much farther, and which of them the scope may take."""
        return self._prover.row(tip.motion, shifts_mm)

    def tip(self, row: TipRow, index: int) -> ScopeTip:
        """Return a tip of a row with its motion."""
        point, forward, sideways = np.split(row.tips[index], 3)
        nearest, _inside = in_tip_region(self._tree, row.tips[index : index + 1])
        return ScopeTip(
            motion=row.motion_to(index),
            lps_from_scope_tip=poses.pose(point, forward, sideways),
            tree_point=int(nearest[0]),
        )

    def moved(self, tip: ScopeTip, shift_mm: float) -> ScopeTip | None:
        """Return a tip moved along its motion, None if the scope may not take it."""
        if shift_mm == 0.0:
            return tip
        row = self.along(tip, [shift_mm])
        return self.tip(row, 0) if row.proved[0] else None
