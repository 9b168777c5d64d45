"""A candidate for a plan: the choices of all three stages, from which everything else follows."""

from __future__ import annotations

from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from lungaccess.plans.curves import deployed_pieces, pieces_beyond
from lungaccess.problem.system import System
from stages.needle import ArcPath
from stages.scope import ScopeTip
from stages.tube import Deployment, pieces_of_arcs


@frozen_record
class Candidate:
    """The choices that make a plan.

    Parameters
    ----------
    tip : ScopeTip
        Where the scope's tip is.
    deployment : Deployment
        The tubes from there.
    path : ArcPath
        What the costs are of: the needle from the tip of the tubes to the target; without a needle, the tubes
        from where they leave the lumen to their tip, which is at the target.
    """

    tip: ScopeTip
    deployment: Deployment
    path: ArcPath


def tubes_in_tissue(system: System, lps_from_scope_tip: Float, deployment: Deployment) -> ArcPath:
    """Return the tubes of a deployment, from where they leave the lumen to their tip, as a path."""
    outer_mm, inner_mm, shape = deployment.outer_mm, deployment.inner_mm, deployment.shape
    if shape is None:
        pieces = deployed_pieces(system.tubes, deployment.rotation_rad, outer_mm, inner_mm)
    else:
        pieces = pieces_of_arcs(shape.arcs, deployment.rotation_rad)
    start, arcs = pieces_beyond(lps_from_scope_tip, pieces, deployment.exit_mm)
    return ArcPath(lps_from_start=start, arcs=arcs)


def wall_in_path_mm(system: System, deployment: Deployment) -> float:
    """Return how much of a candidate's path lies in the wall that is pierced: a needle begins beyond it."""
    return deployment.wall_run_mm if system.needle is None else 0.0
