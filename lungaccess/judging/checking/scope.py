"""Second part of the check: the bronchoscope can move as stated, in the lumen, and its tip ends as stated."""

import numpy as np

from anatomy.airway_tree import AirwayTree
from anatomy.base.typed import Float
from lungaccess.judging.checking.environment import Environment
from lungaccess.judging.checking.findings import Findings
from lungaccess.judging.checking.poses import (
    ANGLE_TOLERANCE_RAD,
    POSITION_TOLERANCE_MM,
    angle_between,
    check_rigid,
    check_same_pose,
)
from lungaccess.judging.checking.scope_motion import TINY_MM, TINY_RAD, Motion, motion_of
from lungaccess.judging.checking.scope_sweep import least_gap_mm
from lungaccess.judging.checking.space import not_lumen
from lungaccess.plans.parts import ScopeInsertion
from lungaccess.problem.system import System
from stages.scope.device import Bronchoscope

START_MM = 30.0
"""A motion begins at most so far from the root of the airway tree: a trachea is about 100 mm long."""
AXIS_TOLERANCE_MM = 0.01
"""Entries are points of the airway tree, so that only rounding lies between them."""
MAX_ANGLE_RAD = np.deg2rad(45.0)
"""A scope looks along the airway, within so much: more means sideways."""
MAX_OFF_AXIS_MM = 3.0
"""Proofs that a target is unreachable rule out tips up to here from the nearest point of the airway tree."""
BODY_STEP_MM = 0.1
"""Spacing of the points of the body among which the nearest to the carina is looked for."""
CARINA_TOLERANCE_MM = 0.1
"""The place of the body that is nearest to a point, by two samplings, agrees to less than this."""
REACH_MM = 1.0
"""Distances are measured so far beyond what is needed: as far as the first cells of a motion reach."""
MARGIN_TOLERANCE_MM = 0.05
"""The stated margin may be so much too large."""
CURVATURE_TOLERANCE_PER_MM = 1e-9
"""Rounding of an angle divided by a length."""


def check_scope(scope: ScopeInsertion, system: System, environment: Environment, found: Findings) -> None:
    """Record everything about the bronchoscope."""
    if not (check_rigid("scope.entry", scope.lps_from_entry, found) & _check_order(scope.states, found)):
        return
    motion = motion_of(scope.lps_from_entry, scope.states, system.scope.bending_length_mm)
    _check_limits(motion, system, found)
    _check_start(motion, environment, found)
    _check_fit(scope, motion, system.scope, environment, found)
    if check_rigid("scope.tip", scope.lps_from_scope_tip, found):
        check_same_pose("scope.tip", scope.lps_from_scope_tip, motion.tip, found)
    _check_end(motion, environment, found)
    _check_statements(scope, motion, environment, found)


def _check_order(states: Float, found: Findings) -> bool:
    """The scope begins at its entry, never draws back, and turns only where it does not advance."""
    if not found.true("scope.states", len(states) > 0, f"{len(states)} states"):
        return False
    steps = np.diff(states, axis=0)
    found.at_most("scope.states.first", abs(float(states[0, 0])), TINY_MM, "mm", "advance of the first state")
    forward = found.at_least(
        "scope.states.forward", float(steps[:, 0].min(initial=0.0)), -TINY_MM, "mm", "smallest advance"
    )
    turns = (np.abs(steps[:, 1:]) > TINY_RAD).any(axis=1)
    both = int((turns & (np.abs(steps[:, 0]) > TINY_MM)).sum())
    return forward & found.true(
        "scope.states.one_at_a_time", both == 0, f"{both} steps advance and turn at once"
    )


def _check_limits(motion: Motion, system: System, found: Findings) -> None:
    """Bends are within those of the device, with the scope standing still and while it lays its shaft."""
    scope, bends = system.scope, motion.states[:, 2]
    up, down = np.deg2rad([scope.bend_up_deg, scope.bend_down_deg])
    found.at_most("scope.bend.up", float(bends.max()), float(up), "rad", "largest bend", TINY_RAD)
    found.at_most("scope.bend.down", float(-bends.min()), float(down), "rad", "largest bend down", TINY_RAD)
    of_section = float(np.abs(bends).max()) / motion.section_mm
    found.at_most(
        "scope.bend.radius", of_section, 1.0 / scope.min_bending_radius_mm, "1/mm",
        "largest curvature of the bending section", CURVATURE_TOLERANCE_PER_MM,
    )  # fmt: skip
    led = np.abs(bends[:-1][motion.moves]).max(initial=0.0) / motion.section_mm
    found.at_most(
        "scope.shaft.radius", float(led), 1.0 / scope.min_shaft_radius_mm, "1/mm",
        "largest curvature of the shaft behind the section", CURVATURE_TOLERANCE_PER_MM,
    )  # fmt: skip


def _check_start(motion: Motion, environment: Environment, found: Findings) -> None:
    """The motion begins on the axis of the trachea, near its beginning, and looks down it."""
    tree, entry = environment.lung.tree, motion.bases[0]
    nearest = int(environment.nearest_tree_points(entry[:3, 3], 1)[0])
    found.true("scope.start.trachea", tree.branch_of_point[nearest] == 0, "branch at the entry")
    gap = float(np.linalg.norm(entry[:3, 3] - tree.points_lps[nearest]))
    found.at_most("scope.start", gap, AXIS_TOLERANCE_MM, "mm", "entry to the axis of the trachea")
    depth = float(tree.distance_from_root_mm[nearest])
    found.at_most("scope.start.depth", depth, START_MM, "mm", "root of the airway tree to the entry")
    tilt = float(angle_between(entry[:3, 2], tree.tangents[nearest]))
    found.at_most("scope.start.direction", tilt, float(MAX_ANGLE_RAD), "rad", "entry to the trachea")


def _check_fit(
    scope: ScopeInsertion, motion: Motion, device: Bronchoscope, environment: Environment, found: Findings
) -> None:
    """The lumen is wide enough for the body in every state and between them, and by as much as stated."""
    radius = 0.5 * device.outer_diameter_mm
    needed = radius + device.lumen_margin_mm
    stated = scope.min_lumen_margin_mm + radius
    boxes = environment.boxes(not_lumen, max(needed, stated) + REACH_MM)
    gap = least_gap_mm(motion, boxes, needed - POSITION_TOLERANCE_MM, stated - MARGIN_TOLERANCE_MM)
    found.at_least(
        "scope.fits",
        gap,
        needed,
        "mm",
        "smallest lumen radius, in all states and between them; needed: radius of the scope plus its margin",
        POSITION_TOLERANCE_MM,
    )
    found.at_most(
        "scope.margin", stated - gap, 0.0, "mm", "stated beyond recomputed margin", MARGIN_TOLERANCE_MM
    )
    detail = "stated margin between scope and wall"
    found.at_least("scope.margin.limit", scope.min_lumen_margin_mm, device.lumen_margin_mm, "mm", detail)


def _check_end(motion: Motion, environment: Environment, found: Findings) -> None:
    """The tip lies where tips may be: beside the axis of the airway, looking on along it."""
    tree, tip = environment.lung.tree, motion.tip
    nearest = int(environment.nearest_tree_points(tip[:3, 3], 1)[0])
    gap = float(np.linalg.norm(tip[:3, 3] - tree.points_lps[nearest]))
    found.at_most(
        "scope.tip.off_axis", gap, MAX_OFF_AXIS_MM, "mm", "tip to the airway tree", POSITION_TOLERANCE_MM
    )
    tilt = float(angle_between(tip[:3, 2], tree.tangents[nearest]))
    found.at_most(
        "scope.tip.forward", tilt, float(MAX_ANGLE_RAD), "rad", "tip to the airway", ANGLE_TOLERANCE_RAD
    )


def _check_statements(
    scope: ScopeInsertion, motion: Motion, environment: Environment, found: Findings
) -> None:
    """Branches, generation, lengths and curvature are what tree and motion say."""
    tree = environment.lung.tree
    nearest = environment.nearest_tree_points(motion.tip[:3, 3], 3)
    last = int(scope.branches[-1]) if len(scope.branches) else -1
    near = sorted({int(branch) for branch in tree.branch_of_point[nearest]})
    if found.true("scope.branch", last in near, f"{last} against {near} at the tip"):
        way = branches_to(tree, last)
        found.true("scope.branches", way == scope.branches.tolist(), "branches from the trachea to the tip")
        generation = int(tree.generation[last])
        detail = f"{scope.generation} against {generation}"
        found.true("scope.generation", scope.generation == generation, detail)
    states, lengths = motion.body_pieces()
    found.agrees("scope.length", scope.length_mm, float(lengths.sum()), POSITION_TOLERANCE_MM, "mm")
    beyond = beyond_carina_mm(motion, tree)
    found.agrees("scope.length_from_carina", scope.length_from_carina_mm, beyond, CARINA_TOLERANCE_MM, "mm")
    most = float(np.hypot(*motion.bends[states].T).max())
    found.agrees("scope.curvature", scope.max_curvature_per_mm, most, CURVATURE_TOLERANCE_PER_MM, "1/mm")


def branches_to(tree: AirwayTree, branch: int) -> list[int]:
    """Return the branches from the trachea to one of them."""
    way = [branch]
    while tree.branch_parent[way[0]] >= 0:
        way.insert(0, int(tree.branch_parent[way[0]]))
    return way


def beyond_carina_mm(motion: Motion, tree: AirwayTree) -> float:
    """Return the length of the body beyond the place of it that is nearest to the carina."""
    points, along = motion.body(BODY_STEP_MM)
    passed = float(along[np.linalg.norm(points - tree.carina_lps, axis=1).argmin()])
    return float(along[-1]) - passed
