"""The concentric tubes: their mechanics, deployments and designs."""

from __future__ import annotations

from typing import TYPE_CHECKING

from anatomy.facade import lazy_exports

if TYPE_CHECKING:
    from stages.tube.deployments import DEFAULT_ROTATIONS as DEFAULT_ROTATIONS
    from stages.tube.deployments import DEFAULT_STOP_MM as DEFAULT_STOP_MM
    from stages.tube.deployments import REASONS as REASONS
    from stages.tube.deployments import Deployment as Deployment
    from stages.tube.deployments import Deployments as Deployments
    from stages.tube.deployments import TubeJudge as TubeJudge
    from stages.tube.deployments import enumerate_deployments as enumerate_deployments
    from stages.tube.deployments import joined as joined
    from stages.tube.deployments import scene_of as scene_of
    from stages.tube.deployments import tracking_length_mm as tracking_length_mm
    from stages.tube.deployments import tube_constants as tube_constants
    from stages.tube.device import ConcentricTubes as ConcentricTubes
    from stages.tube.device import Tube as Tube
    from stages.tube.following import DeployedSequence as DeployedSequence
    from stages.tube.following import SnapError as SnapError
    from stages.tube.following import deploy as deploy
    from stages.tube.mechanics import Equilibrium as Equilibrium
    from stages.tube.mechanics import TubeMechanics as TubeMechanics
    from stages.tube.mechanics import check_nesting as check_nesting
    from stages.tube.proposals import DesignProposal as DesignProposal
    from stages.tube.proposals import MakerLimits as MakerLimits
    from stages.tube.proposals import SequenceComparison as SequenceComparison
    from stages.tube.proposals import judge_design as judge_design
    from stages.tube.proposals import least_sweep_sequence as least_sweep_sequence
    from stages.tube.proposals import propose_designs as propose_designs
    from stages.tube.sequences import kuntz2015 as kuntz2015
    from stages.tube.shape import centreline as centreline

__getattr__, __dir__ = lazy_exports(__name__, __file__)
