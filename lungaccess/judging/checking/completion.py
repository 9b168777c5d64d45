"""A whole plan from bare motions: what it has to state is filled in by the arithmetic of the check.

Who plans elsewhere says how the devices move, nothing else: the states of the scope, the insertions of the
tubes with the shape that the mechanics make of them, the arcs of the needle, and the poses between them.  A
plan states more, such as where the tubes leave the lumen.  Filled in here, those statements are true by
construction, so that the check of such a plan speaks of its motions alone; poses that were stated stay as
they are.  The angle to the wall is known to `WALL_ANGLE_TOLERANCE_RAD` alone: where it may be the least one
that is allowed, that is what is filled in, as a planner could have stated it.
"""

from dataclasses import replace

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from lungaccess.judging.checking import shapes, wall_exit
from lungaccess.judging.checking.boxes import Environment
from lungaccess.judging.checking.outcome import recomputed_costs
from lungaccess.judging.checking.record import wanted_clearance_mm
from lungaccess.judging.checking.scope import beyond_carina_mm, branches_to, motion_of
from lungaccess.judging.checking.steering import turning
from lungaccess.plans import parts
from lungaccess.plans.plan import Plan
from lungaccess.plans.version import software_version
from lungaccess.problem.system import System, system_fingerprint

OBJECTIVE = "inverse_clearance"


@frozen_record
class Motions:
    """How tubes and a needle are brought to a target: all that somebody else's planner has to say.

    Args:
        lps_from_entry, states, lps_from_scope_tip: As in `lungaccess.plans.parts.ScopeInsertion`.
        rotation_rad, outer_insertion_mm, inner_insertion_mm: As in `lungaccess.plans.parts.TubeDeployment`.
        shape, lateral_sweep_mm, follow_the_leader_error_mm: What the mechanics make of the insertions.
        lps_from_tube_tip ((4, 4) float64): Where the needle leaves the inner tube; see
            `lungaccess.plans.parts.TubeDeployment`.
        arcs: At least one.
    """

    lps_from_entry: Float
    states: Float
    lps_from_scope_tip: Float
    rotation_rad: float
    outer_insertion_mm: float
    inner_insertion_mm: float
    shape: parts.DeployedShape
    lateral_sweep_mm: float
    follow_the_leader_error_mm: float
    lps_from_tube_tip: Float
    arcs: tuple[parts.NeedleArc, ...]


def completed_plan(
    motions: Motions, environment: Environment, system: System, target_lps: Float, *, method: str
) -> Plan:
    """Return the plan that motions make, to be checked by `Checker.check`.

    Nothing is judged here: where tubes do not leave the lumen, the plan states an exit that is none, and the
    check refuses it.

    Args:
        system: With a needle, and an outer and an inner tube or one tube.
        target_lps: (3,) float64, LPS mm.
    """
    lung = environment.lung
    needle = system.require_needle("A plan of bare motions")
    tube = parts.TubeDeployment(
        rotation_rad=motions.rotation_rad,
        outer_insertion_mm=motions.outer_insertion_mm,
        inner_insertion_mm=motions.inner_insertion_mm,
        lps_from_tip=motions.lps_from_tube_tip,
        exit=parts.WallExit(
            branch=0, point_lps=np.zeros(3), arc_length_mm=0.0, wall_angle_rad=0.0, wall_run_mm=0.0
        ),
        lateral_sweep_mm=motions.lateral_sweep_mm,
        follow_the_leader_error_mm=motions.follow_the_leader_error_mm,
        shape=motions.shape,
    )
    pieces = shapes.cut_at(motions.arcs, needle.exit_exemption_mm)
    curve = shapes.integrate(motions.lps_from_tube_tip, pieces)
    turned, angle = turning(curve)
    draft = Plan(
        software_version=software_version(),
        patient_name=lung.name,
        lung_key=lung.key,
        sources=lung.sources,
        breath_hold=lung.breath_hold,
        system=system,
        system_fingerprint=system_fingerprint(system),
        target_lps=np.asarray(target_lps, dtype=np.float64),
        target_origin="point",
        fissures_are_obstacles=lung.has_fissures and not system.fissures_allowed,
        objective=OBJECTIVE,
        scope=_scope(motions, environment, system),
        tube=tube,
        needle=parts.NeedlePath(
            lps_from_start=motions.lps_from_tube_tip,
            arcs=motions.arcs,
            end_lps=curve.points[-1],
            length_mm=float(sum(arc.length_mm for arc in motions.arcs)),
            max_angle_from_start_rad=angle,
            accumulated_turn_rad=turned,
        ),
        exemption=parts.Exemption(
            branch=0, exit_point_lps=np.zeros(3), needle_length_mm=needle.exit_exemption_mm
        ),
        required_clearance_mm=wanted_clearance_mm(system),
        clearance_mm={"tube": {}, "needle": {}},
        costs={},
        method=method,
        seed=0,
        iterations=0,
        timing={},
    )
    whole = _with_exit(draft, environment)
    costs = recomputed_costs(whole, environment, curve)
    return replace(whole, costs={name: cost.value for name, cost in costs.items()})


def _scope(motions: Motions, environment: Environment, system: System) -> parts.ScopeInsertion:
    tree = environment.lung.tree
    motion = motion_of(motions.lps_from_entry, motions.states, system.scope.bending_length_mm)
    nearest = int(environment.nearest_tree_points(motion.tip[:3, 3], 1)[0])
    branches = branches_to(tree, int(tree.branch_of_point[nearest]))
    states, lengths = motion.body_pieces()
    return parts.ScopeInsertion(
        lps_from_entry=motions.lps_from_entry,
        states=motions.states,
        lps_from_scope_tip=motions.lps_from_scope_tip,
        branches=np.array(branches, dtype=np.int64),
        generation=int(tree.generation[branches[-1]]),
        length_mm=float(lengths.sum()),
        length_from_carina_mm=beyond_carina_mm(motion, tree),
        min_lumen_margin_mm=system.scope.lumen_margin_mm,
        max_curvature_per_mm=float(np.hypot(*motion.bends[states].T).max()),
    )


def _with_exit(plan: Plan, environment: Environment) -> Plan:
    """Return a plan that states where its tubes leave the lumen."""
    lung, tube = environment.lung, plan.tube
    if not 0.0 <= tube.outer_insertion_mm <= tube.inner_insertion_mm or tube.inner_insertion_mm <= 0.0:
        return plan
    pieces = shapes.tube_pieces(plan)
    curve = shapes.integrate(plan.scope.lps_from_scope_tip, pieces)
    derived = wall_exit.derived_exit(lung, curve)
    if derived is None:
        return plan
    way_out, point = derived
    curve_cut = shapes.integrate(plan.scope.lps_from_scope_tip, shapes.cut_at(pieces, way_out.arc_mm))
    frame = int(np.abs(curve_cut.arc_mm - way_out.arc_mm).argmin())
    run, _most = wall_exit.wall_run_mm(plan, environment, curve_cut, replace(way_out, frame=frame))
    angle = wall_exit.wall_angle_rad(lung, point, curve.tangents[way_out.frame])
    least = float(np.deg2rad(plan.system.tubes.min_wall_angle_deg))
    stated = parts.WallExit(
        branch=way_out.branch,
        point_lps=point,
        arc_length_mm=way_out.arc_mm,
        wall_angle_rad=max(angle, min(least, angle + wall_exit.WALL_ANGLE_TOLERANCE_RAD)),
        wall_run_mm=run,
    )
    exemption = replace(plan.exemption, branch=way_out.branch, exit_point_lps=point)
    return replace(plan, tube=replace(tube, exit=stated), exemption=exemption)
