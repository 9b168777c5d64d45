"""The concentric tubes: their mechanics, deployments and designs."""

from typing import TYPE_CHECKING

from anatomy.base.facade import lazy_exports

if TYPE_CHECKING:
    from stages.tube.arcs import TubeShape, pieces_of_arcs, points_on_arcs
    from stages.tube.casadi_model import CasadiTubes
    from stages.tube.casadi_shape import DerivedShape, LoadedShape, derive_loaded, derive_shape
    from stages.tube.deployments import (
        DEFAULT_STOP_MM,
        Deployments,
        Enumerator,
        SiteEnumerator,
        enumerate_deployments,
        exit_points,
        join_deployments,
    )
    from stages.tube.design_shapes import (
        coarser_shapes,
        longest_mm,
        open_shapes,
        shapes_at_hand,
        shapes_digest,
        shapes_format,
        shapes_of,
        tree_of_shapes,
    )
    from stages.tube.device import BentPiece, ConcentricTubes, Tube, straightening
    from stages.tube.equilibrium import Equilibrium, check_nesting
    from stages.tube.errors import ConvergenceError
    from stages.tube.following import DeployedSequence, SnapError, deploy
    from stages.tube.kernels import DesignArrays, ManyShapes, ShapeArrays, TubeEnvironment
    from stages.tube.mechanics import Batch, TubeMechanics
    from stages.tube.one_shape import (
        DEFAULT_ROTATIONS,
        Neighbourhood,
        copies,
        deployed,
        design_arrays,
        many_shapes,
        shape_arrays,
        shape_of_arrays,
        shape_or_reason,
        tube_constants,
        tube_environment,
        with_any_sweep,
        without_limits,
    )
    from stages.tube.proposals import (
        DesignProposal,
        MakerLimits,
        SequenceComparison,
        evaluate_design,
        least_sweep_sequence,
        propose_designs,
    )
    from stages.tube.sequences import BEND_RAD, Sequence, alternating, inner_first, kuntz2015, together
    from stages.tube.shapes import ShapeGrid, ShapeLimits, TubeShapes, tube_shapes
    from stages.tube.validation import REASONS, Deployment, DeploymentValidator

__getattr__, __dir__ = lazy_exports(__name__, __file__)
