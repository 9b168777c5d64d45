"""A candidate for a plan: the choices of all three stages, from which everything else follows."""

from __future__ import annotations

from anatomy.records import frozen_record
from stages.needle import ArcPath
from stages.scope import ScopeTip
from stages.tube import Deployment


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
        The needle from the tip of the tubes to the target.
    """

    tip: ScopeTip
    deployment: Deployment
    path: ArcPath
