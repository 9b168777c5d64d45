"""What a plan states of the motion of its bronchoscope."""

from dataclasses import replace

import numpy as np

from anatomy.airway_tree import AirwayTree
from anatomy.base.typed import Float
from anatomy.lung import Lung
from lungaccess.plans.parts import ScopeInsertion
from lungaccess.plans.plan import Plan
from lungaccess.problem.channel import bends_with_tubes_rad
from stages.scope import ScopeMotion, prover_of

SHOWN_STEP_MM, SHOWN_TURN_RAD = 1.0, 0.06
"""Largest advance and turn between two states of a motion that is shown or told."""


def scope_insertion(
    motion: ScopeMotion, tree: AirwayTree, tree_point: int, min_lumen_margin_mm: float
) -> ScopeInsertion:
    """Return the part of a plan that a motion makes.

    Args:
        tree_point: Its point nearest to the tip.
        min_lumen_margin_mm: Smallest lumen depth of the body's axis over the whole motion, minus the radius
            of the scope.
    """
    branches = [int(tree.branch_of_point[tree_point])]
    while (parent := int(tree.branch_parent[branches[0]])) >= 0:
        branches.insert(0, parent)
    length = motion.length_mm
    return ScopeInsertion(
        lps_from_entry=motion.lps_from_entry,
        states=motion.states,
        lps_from_scope_tip=motion.lps_from_tip,
        branches=np.array(branches),
        generation=int(tree.generation[branches[-1]]),
        length_mm=length,
        length_from_carina_mm=length - _passes_mm(motion, tree.carina_lps),
        min_lumen_margin_mm=min_lumen_margin_mm,
        max_curvature_per_mm=motion.max_curvature_per_mm,
    )


def scope_motion(plan: Plan) -> ScopeMotion:
    """Return the motion of a plan's bronchoscope."""
    return ScopeMotion(
        lps_from_entry=plan.scope.lps_from_entry,
        states=plan.scope.states,
        bending_length_mm=plan.system.scope.bending_length_mm,
    )


def with_simplest_motion(plan: Plan, lung: Lung) -> Plan:
    """Return a plan whose scope comes to the same tip by fewer changes and twists, where they are found.

    The tip's frame, tubes, needle and costs stay; what the plan states of the motion is that of the new one.
    """
    prover, system = prover_of(lung, plan.system.scope), plan.system
    motion = prover.simplest(
        scope_motion(plan),
        max_curvature_per_mm=system.tubes.channel_curvature_per_mm,
        end_bends_rad=bends_with_tubes_rad(system),
    )
    margin_mm = prover.prove(motion)
    if isinstance(margin_mm, str) or np.array_equal(motion.states, plan.scope.states):
        return plan
    scope = replace(
        plan.scope,
        states=motion.states,
        length_mm=motion.length_mm,
        length_from_carina_mm=motion.length_mm - _passes_mm(motion, lung.tree.carina_lps),
        min_lumen_margin_mm=margin_mm + system.scope.lumen_margin_mm,
        max_curvature_per_mm=motion.max_curvature_per_mm,
    )
    return replace(plan, scope=scope)


def shown_motion(plan: Plan) -> ScopeMotion:
    """Return the motion of a plan's bronchoscope with so many states that a film of them is smooth."""
    return scope_motion(plan).between(SHOWN_STEP_MM, SHOWN_TURN_RAD)


def _passes_mm(motion: ScopeMotion, point_lps: Float) -> float:
    """Return the length of the body in the last state up to where it is nearest to a point."""
    # Spacing of the points of a body that are taken as a polyline to find where it passes a place.
    points = motion.body(0.25)[:, :3, 3]
    steps = np.diff(points, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    along = ((point_lps - points[:-1]) * steps).sum(axis=1) / np.maximum(lengths, 1e-12) ** 2
    share = np.clip(along, 0.0, 1.0)
    nearest = int(np.linalg.norm(points[:-1] + share[:, None] * steps - point_lps, axis=1).argmin())
    return float(lengths[:nearest].sum() + share[nearest] * lengths[nearest])
