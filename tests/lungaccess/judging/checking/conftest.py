"""A toy patient with a plan made by hand: closed-form shapes and brute-force distances, nothing shared."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from anatomy import structures
from anatomy.airway_tree import AirwayTree
from anatomy.grid import Grid, Volume, read_only, transform_points
from experiments.support.mutants.mutant import changed
from lungaccess.plans.parts import Exemption, NeedleArc, NeedlePath, ScopeInsertion, TubeDeployment, WallExit
from lungaccess.plans.plan import Plan
from lungaccess.problem.system import System, load_system, system_fingerprint
from stages.scope import ScopeMotion
from tests.lungaccess.pursuit import pursued
from tests.lungaccess.rigid import arc, turned
from tests.lungaccess.tube_shapes import shared_curvatures, stated_shape
from tests.stages.scenes import box_distance, forked_tree

SPACING_MM = (1.0, 0.9, 1.1)
SHAPE = (150, 64, 104)
BRANCH_END = np.array([40.0, 0.0, 12.0])
CARINA = np.array([0.0, 0.0, 70.0])
MAIN_END = CARINA + 0.2 * (BRANCH_END - CARINA)
WALL_MM = 1.0
BRANCHES = (
    (np.array([0.0, 0.0, 88.0]), CARINA, 6.0, -1),
    (CARINA, MAIN_END, 5.0, 0),
    (CARINA, BRANCH_END * [-1, 1, 1], 4.0, 0),
    (MAIN_END, BRANCH_END, 4.0, 1),
)
"""From, to, radius (mm) and parent of trachea, two main bronchi, and a lobar bronchus."""
LOBAR = 3
SITE_STEP = 20
OUTER_MM, INNER_MM = 20.0, 39.5
STRAIGHTENED_RAD = 0.08
TOWARDS = np.array([1.0, -0.2, 0.0])
"""Where the tubes bend to."""
ARCS = ((6.0, 0.4, 0.0), (10.0, 1.1, 0.008), (9.0, -2.0, 0.004))
EXEMPT_MM = 5.0


def toy_tree() -> AirwayTree:
    """The branches as points 0.5 mm apart."""
    return forked_tree(list(BRANCHES))


def capsule(points: np.ndarray, a: np.ndarray, b: np.ndarray, radius_mm: float) -> np.ndarray:
    """Points within `radius_mm` of a segment."""
    t = np.clip(((points - a) @ (b - a)) / ((b - a) @ (b - a)), 0.0, 1.0)
    return np.linalg.norm(points - a - t[..., None] * (b - a), axis=-1) <= radius_mm


def toy_lung() -> Any:
    """What the check reads of a lung: two lungs apart, a forked airway with a wall, a vessel, a fissure."""
    grid = Grid.from_spacing(SHAPE, SPACING_MM, [-58.0, -28.4, -12.0])
    points = grid.lps(np.stack(np.meshgrid(*map(np.arange, SHAPE), indexing="ij"), axis=-1))
    tree = toy_tree()
    x, y, z = np.moveaxis(points, -1, 0)
    labels = np.zeros(SHAPE, dtype=np.uint16, order="F")
    labels[(np.abs(x) < 1.0) | (x > 84) | (x < -52) | (np.abs(y) > 24) | (z < -5) | (z > 80)] = (
        structures.OUTSIDE
    )
    lumen, wall = np.zeros((2, *SHAPE), dtype=bool)
    for a, b, r in ((np.array([0.0, 0, 96]), CARINA, 6.0), *(branch[:3] for branch in BRANCHES)):
        lumen |= capsule(points, a, b, r)
        wall |= capsule(points, a, b, r + WALL_MM)
    vessel = capsule(points, np.array([30.0, 8.0, 60.0]), np.array([80.0, 9.0, 5.0]), 3.0) & ~wall
    labels[vessel] |= structures.VESSEL
    labels[(np.abs(z - 6.0) < 0.6) & ~wall & (labels == 0)] |= structures.FISSURE
    voxels = np.argwhere(wall)
    gap = np.linalg.norm(grid.lps(voxels)[:, None] - tree.points_lps[None, ::4], axis=2) - tree.radius_mm[::4]
    branch = tree.branch_of_point[::4][gap.argmin(axis=1)]
    labels[tuple(voxels.T)] = structures.AIRWAY | ((branch + 1) << structures.BRANCH_SHIFT).astype(np.uint16)
    labels[lumen] |= structures.LUMEN
    return SimpleNamespace(
        name="Toy",
        kind="toy",
        key="abc123",
        grid=grid,
        labels=read_only(labels),
        tree=tree,
        cost=None,
        has_fissures=True,
        fissure_band=None,
        nodules=None,
        breath_hold="inspiration",
        motion=None,
        sources={"airway.nii.gz": "0" * 64},
        warnings=(),
    )


def follow(
    pose: np.ndarray, arcs: list[tuple[float, float, float]], step: float
) -> tuple[np.ndarray, np.ndarray]:
    """Frames along arcs of (length, roll, curvature), and their arc lengths."""
    frames, at, travelled = [pose], [0.0], 0.0
    for length, roll, k in arcs:
        pose = turned(pose, roll)
        for s in np.linspace(0, length, max(int(np.ceil(length / step)), 1) + 1)[1:]:
            frames.append(pose @ arc(s, k))
            at.append(travelled + s)
        pose, travelled = pose @ arc(length, k), travelled + length
    return np.array(frames), np.array(at)


def brute_distance(lung: Any, mask: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Distances to the voxels of a mask as solid boxes, at most 20 mm."""
    spacing = np.asarray(SPACING_MM)
    local = transform_points(np.linalg.inv(lung.grid.lps_from_ijk), points) * spacing
    boxes = np.argwhere(mask) * spacing
    boxes = boxes[((boxes >= local.min(axis=0) - 21.0) & (boxes <= local.max(axis=0) + 21.0)).all(axis=1)]
    return np.minimum(box_distance(local, boxes, spacing), 20.0)


def is_airway_of(labels: np.ndarray, branch: int) -> np.ndarray:
    """Airway voxels of one branch."""
    return ((labels & structures.AIRWAY) != 0) & (
        (labels >> structures.BRANCH_SHIFT).astype(int) - 1 == branch
    )


def toy_plan(
    lung: Any,
    system: System,
    outer_mm: float,
    inner_mm: float,
    arcs: Any = ARCS,
    straightened_rad: float = STRAIGHTENED_RAD,
) -> Plan:
    """The plan, every stated value from closed forms and brute force."""
    scope = toy_scope(lung, system, straightened_rad)
    tube, tube_points, exit_at = toy_tube(lung, system, scope.lps_from_scope_tip, outer_mm, inner_mm)
    frames, at = follow(tube.lps_from_tip, list(arcs), 0.1)
    points, tangents = frames[:, :3, 3], frames[:, :3, 2]
    labels, branch = lung.labels, tube.exit.branch
    masks = {"vessel": structures.VESSEL, "outside": structures.OUTSIDE, "fissure": structures.FISSURE}
    clear: dict[str, dict[str, float]] = {"tube": {}, "needle": {}}
    every = np.full(len(points), np.inf)
    for name, bit in masks.items():
        gap = brute_distance(lung, (labels & bit) != 0, points)
        every = np.minimum(every, gap)
        clear["needle"][name] = float(gap.min())
        clear["tube"][name] = float(brute_distance(lung, (labels & bit) != 0, tube_points[:exit_at:-5]).min())
    airway = (labels & structures.AIRWAY) != 0
    gap = brute_distance(lung, airway, points)
    clear["needle"]["airway"] = float(gap[at >= EXEMPT_MM].min())
    other = airway & ~is_airway_of(labels, branch)
    clear["tube"]["airway"] = float(brute_distance(lung, other, tube_points[:exit_at:-5]).min())
    every = np.maximum(np.minimum(every, gap), 0.1)
    length = float(sum(a[0] for a in arcs))
    angle = np.arccos(np.clip(tangents @ tangents[0], -1, 1)).max()
    needle = NeedlePath(
        lps_from_start=tube.lps_from_tip,
        end_lps=points[-1],
        length_mm=length,
        arcs=tuple(NeedleArc(length_mm=a, roll_rad=b, curvature_per_mm=c) for a, b, c in arcs),
        max_angle_from_start_rad=float(angle),
        accumulated_turn_rad=float(sum(a[0] * a[2] for a in arcs)),
    )
    margin = system.margins.total_mm
    return Plan(
        software_version="0",
        patient_name=lung.name,
        lung_key=lung.key,
        sources=lung.sources,
        breath_hold=lung.breath_hold,
        system=system,
        system_fingerprint=system_fingerprint(system),
        target_lps=points[-1],
        target_origin="lps",
        fissures_are_obstacles=True,
        objective="inverse_clearance",
        scope=scope,
        tube=tube,
        needle=needle,
        exemption=Exemption(branch=branch, exit_point_lps=tube.exit.point_lps, needle_length_mm=EXEMPT_MM),
        required_clearance_mm={
            "outer_tube": system.tubes.outer.radius_mm + margin,
            "inner_tube": system.tubes.inner.radius_mm + margin,
            "needle": system.needle.radius_mm + margin,
        },
        clearance_mm=clear,
        costs={"inverse_clearance": float(np.trapezoid(1 / every, at)), "cost_map": 0.0, "length_mm": length},
        method="hand",
        seed=0,
        iterations=1,
        timing={"total_s": 1.0},
    )


def toy_scope(lung: Any, system: System, straightened_rad: float) -> ScopeInsertion:
    """Down the trachea and some way into the lobar bronchus, by pursuit; at last the tip straightens."""
    tree: AirwayTree = lung.tree
    site = int(tree.branch_start[LOBAR]) + SITE_STEP
    length, section = float(tree.distance_from_root_mm[site]), system.scope.bending_length_mm
    led = pursued(tree.points_lps[tree.route(site)], length, section, np.array([1.0, 0.3, 0.0]))
    advance, twist, bend = led.states[-1]
    bend -= straightened_rad
    motion = replace(led, states=np.append(led.states, [[advance, twist, bend]], axis=0))
    margin = least_depth(lung, motion) - system.scope.radius_mm
    points = motion.body(0.05)[:, :3, 3]
    passed = 0.05 * float(np.linalg.norm(points - CARINA, axis=1).argmin())
    return ScopeInsertion(
        lps_from_entry=motion.lps_from_entry,
        states=motion.states,
        lps_from_scope_tip=motion.lps_from_tip,
        branches=np.array([0, 1, LOBAR]),
        generation=2,
        length_mm=advance + section,
        length_from_carina_mm=advance + section - passed,
        min_lumen_margin_mm=margin - 0.02,
        max_curvature_per_mm=motion.max_curvature_per_mm,
    )


_least_depths: dict[tuple[int, ...], float] = {}


def least_depth(lung: Any, motion: ScopeMotion) -> float:
    """The least of `brute_depth`, which is measured once for each lung and motion."""
    section = np.array(motion.bending_length_mm)
    known = (lung.labels, lung.grid.lps_from_ijk, motion.lps_from_entry, motion.states, section)
    key = tuple(zlib.crc32(array.tobytes()) for array in known)
    if key not in _least_depths:
        _least_depths[key] = float(brute_depth(lung, motion).min())
    return _least_depths[key]


def brute_depth(lung: Any, motion: ScopeMotion) -> np.ndarray:
    """Depths in the lumen of the sections in all states."""
    advance = motion.states[:, 0]
    points = []
    for n in range(len(motion.states)):
        until = replace(motion, states=motion.states[: n + 1])
        points.append(until.body(0.5)[-31:, :3, 3])
    assert advance[0] == 0.0
    return brute_distance(lung, (lung.labels & structures.LUMEN) == 0, np.concatenate(points))


def toy_tube(
    lung: Any, system: System, tip: np.ndarray, outer_mm: float, inner_mm: float
) -> tuple[TubeDeployment, np.ndarray, int]:
    """The tubes from the scope tip, their points 0.005 mm apart, and which of them is the exit."""
    tubes = system.tubes
    kappa, overlap = shared_curvatures(system)
    curved = max(inner_mm - tubes.inner.curved_length_mm, 0.0)
    across = tip[:3, :3].T @ TOWARDS
    rotation = float(np.arctan2(across[1], across[0]))
    pieces = [(curved, rotation, 0.0)] if curved else []
    pieces += [(outer_mm - curved, 0.0 if curved else rotation, overlap), (inner_mm - outer_mm, 0.0, kappa)]
    frames, at = follow(tip, pieces, 0.005)
    points = frames[:, :3, 3]
    index = np.rint(lung.grid.ijk(points)).astype(int)
    labels = lung.labels[tuple(index.T)]
    last = int(np.flatnonzero((labels & structures.LUMEN) != 0)[-1])
    centres = lung.grid.lps(np.argwhere((lung.labels & structures.LUMEN) != 0))
    near = centres[np.linalg.norm(centres - points[last], axis=1) <= 2.5]
    out = points[last] - near.mean(axis=0)
    angle = np.arcsin(out @ frames[last, :3, 2] / np.linalg.norm(out))
    behind = brute_distance(lung, (lung.labels & structures.AIRWAY) != 0, points[last:-1])
    radius = np.where(at[last:-1] < outer_mm, tubes.outer.radius_mm, tubes.inner.radius_mm)
    wall_exit = WallExit(
        branch=int(labels[last] >> structures.BRANCH_SHIFT) - 1,
        point_lps=points[last],
        arc_length_mm=float(at[last]),
        wall_angle_rad=float(angle),
        wall_run_mm=float(np.diff(at[last:])[behind < radius].sum()),
    )
    tube = TubeDeployment(
        rotation_rad=rotation,
        outer_insertion_mm=outer_mm,
        inner_insertion_mm=inner_mm,
        lps_from_tip=frames[-1],
        exit=wall_exit,
        lateral_sweep_mm=0.0,
        follow_the_leader_error_mm=0.0,
        shape=stated_shape(tubes, outer_mm, inner_mm),
    )
    return tube, points, last


def relabelled(lung: Any, edit: Callable[[np.ndarray, np.ndarray], None]) -> Any:
    """A copy of the lung after `edit(labels, points_lps)`."""
    labels = lung.labels.copy(order="F")
    points = lung.grid.lps(np.stack(np.meshgrid(*map(np.arange, labels.shape), indexing="ij"), axis=-1))
    edit(labels, points)
    return SimpleNamespace(**{**vars(lung), "labels": labels})


@pytest.fixture(scope="session")
def system() -> System:
    return load_system("thin-scope")


@pytest.fixture(scope="session")
def lung() -> Any:
    return toy_lung()


@pytest.fixture(scope="session")
def plan(lung: Any, system: System) -> Plan:
    return toy_plan(lung, system, OUTER_MM, INNER_MM)


@pytest.fixture(scope="session")
def tools() -> Any:
    """The helpers of this file."""
    return SimpleNamespace(
        changed=changed,
        relabelled=relabelled,
        toy_plan=toy_plan,
        capsule=capsule,
        follow=follow,
        arc=arc,
        brute_distance=brute_distance,
        turned=turned,
        Volume=Volume,
    )
