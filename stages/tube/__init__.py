"""The concentric tubes: their mechanics, deployments and designs."""

from __future__ import annotations

from typing import TYPE_CHECKING

from anatomy.facade import lazy_exports

if TYPE_CHECKING:
    from stages.tube.casadi_model import CasadiTubes as CasadiTubes
    from stages.tube.deployments import DEFAULT_ROTATIONS as DEFAULT_ROTATIONS
    from stages.tube.deployments import DEFAULT_STOP_MM as DEFAULT_STOP_MM
    from stages.tube.deployments import Deployments as Deployments
    from stages.tube.deployments import enumerate_deployments as enumerate_deployments
    from stages.tube.deployments import insertion_stops as insertion_stops
    from stages.tube.deployments import join_deployments as join_deployments
    from stages.tube.device import BentPiece as BentPiece
    from stages.tube.device import ConcentricTubes as ConcentricTubes
    from stages.tube.device import Tube as Tube
    from stages.tube.environment import tracking_length_mm as tracking_length_mm
    from stages.tube.environment import tube_constants as tube_constants
    from stages.tube.environment import tube_environment as tube_environment
    from stages.tube.equilibrium import Equilibrium as Equilibrium
    from stages.tube.following import DeployedSequence as DeployedSequence
    from stages.tube.following import SnapError as SnapError
    from stages.tube.following import deploy as deploy
    from stages.tube.inverse import inverse_kinematics as inverse_kinematics
    from stages.tube.kernels import TubeEnvironment as TubeEnvironment
    from stages.tube.mechanics import Batch as Batch
    from stages.tube.mechanics import TubeMechanics as TubeMechanics
    from stages.tube.nesting import check_nesting as check_nesting
    from stages.tube.proposals import DesignProposal as DesignProposal
    from stages.tube.proposals import MakerLimits as MakerLimits
    from stages.tube.proposals import SequenceComparison as SequenceComparison
    from stages.tube.proposals import evaluate_design as evaluate_design
    from stages.tube.proposals import least_sweep_sequence as least_sweep_sequence
    from stages.tube.proposals import propose_designs as propose_designs
    from stages.tube.sequences import Sequence as Sequence
    from stages.tube.sequences import alternating as alternating
    from stages.tube.sequences import inner_first as inner_first
    from stages.tube.sequences import kuntz2015 as kuntz2015
    from stages.tube.sequences import together as together
    from stages.tube.shape import centreline as centreline
    from stages.tube.validation import REASONS as REASONS
    from stages.tube.validation import Deployment as Deployment
    from stages.tube.validation import DeploymentValidator as DeploymentValidator

__getattr__, __dir__ = lazy_exports(__name__, __file__)
