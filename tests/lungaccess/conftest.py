"""A small hand-made patient and plan: two ellipsoid lungs, a forked airway, two vessels, one nodule.

What the pictures and the command line show needs no real anatomy.
"""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import ndimage

import lungaccess as la
from anatomy.airway_tree import AirwayTree
from anatomy.fields import corner_geometry, distance_field
from anatomy.grid import Grid, Volume, read_only
from anatomy.lung import Lung
from anatomy.morphology import components
from anatomy.motion.prepare import prepare_motion
from anatomy.phantom import Phantom
from anatomy.phantom.files import PhantomBreathing
from anatomy.structures import BITS
from lungaccess.cli import terminal
from lungaccess.plans.parts import Exemption, NeedleArc, NeedlePath, ScopeInsertion, TubeDeployment, WallExit
from lungaccess.plans.plan import Plan
from lungaccess.problem.system import load_system, system_fingerprint
from stages.needle import arc_transform
from tests.lungaccess.pursuit import pursued
from tests.lungaccess.tube_shapes import shared_curvatures, stated_shape

LEFT_LUNG_LPS = np.array([60.0, 0.0, 0.0])
RIGHT_LUNG_LPS = np.array([-60.0, 0.0, 0.0])
TARGET_LPS = np.array([92.0, -16.0, -8.0])
SPACING_MM = (1.5, 1.5, 2.0)


class _Field:
    def __init__(self, grid: Grid, mask: np.ndarray) -> None:
        self._grid = grid
        self._distance = ndimage.distance_transform_edt(~mask, sampling=SPACING_MM)

    def lower_bound_mm(self, lps: np.ndarray) -> np.ndarray:
        return ndimage.map_coordinates(self._distance, self._grid.ijk(lps).T, order=1, mode="nearest")


@pytest.fixture
def wide_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let no line break depend on the terminal of the test."""
    for console in (terminal.console, terminal.error_console):
        monkeypatch.setattr(console, "_width", 200)
    # A command of a test before, in the same process, may have asked for JSON alone.
    monkeypatch.setattr(terminal.console, "quiet", False)


@pytest.fixture(scope="session")
def breathing_lung(small_phantom: Phantom, small_lung: Lung) -> Lung:
    """The lung of the small phantom with its breathing; its masks show end-inhale."""
    return breathing(small_phantom, small_lung)


def breathing(phantom: Phantom, lung: Lung) -> Lung:
    """Return the lung of a phantom with its breathing."""
    source = PhantomBreathing.of(phantom).source(phantom)
    middle_mm = float(lung.tree.carina_lps[0])
    return replace(lung, motion=prepare_motion(source, lung.labels, lung.grid, middle_mm))


@pytest.fixture(scope="session")
def breathing_atlas(breathing_lung: Lung, small_atlas: la.Atlas) -> la.Atlas:
    """What scope and tubes can do in the small phantom, with its breathing."""
    return replace(small_atlas, lung=breathing_lung)


@pytest.fixture(scope="session")
def small_plan(breathing_atlas: la.Atlas) -> Plan:
    """A plan to the nodule of the small phantom, which the check accepts."""
    lung, system = breathing_atlas.lung, breathing_atlas.system
    *_, best = la.plan(
        lung, system, la.resolve_target(lung), atlas=breathing_atlas, iterations=20, goal="default"
    )
    return best


class _Toy(SimpleNamespace):
    """What is read of a Lung; provers are kept by lungs."""

    __hash__ = object.__hash__


def _segment(points: np.ndarray, a: list[float], b: list[float], radius: float) -> np.ndarray:
    start, axis = np.array(a), np.array(b) - np.array(a)
    t = np.clip(((points - start) @ axis) / (axis @ axis), 0, 1)
    return np.linalg.norm(points - start - t[..., None] * axis, axis=-1) <= radius


def make_lung(*, fissures: bool = True, nodule: bool = True) -> Any:
    """Return what the pictures read of a Lung."""
    shape = (168, 112, 100)
    grid = Grid.from_spacing(shape, SPACING_MM, [-126.0, -84.0, -100.0])
    points = grid.lps(np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1))
    lung = np.zeros(shape, dtype=bool)
    for centre in (LEFT_LUNG_LPS, RIGHT_LUNG_LPS):
        lung |= (((points - centre) / np.array([50.0, 72.0, 88.0])) ** 2).sum(axis=-1) < 1
    trunk = [([0, 10, 95], [0, 5, 30], 9.0), ([0, 5, 30], [50, 0, 0], 6.0), ([0, 5, 30], [-50, 0, 0], 6.0)]
    trunk += [([50, 0, 0], [85, -5, 40], 3.5), ([50, 0, 0], [70, 0, -40], 3.5)]
    lumen = np.zeros(shape, dtype=bool)
    wall = np.zeros(shape, dtype=bool)
    for a, b, radius in trunk:
        lumen |= _segment(points, a, b, radius)
        wall |= _segment(points, a, b, radius + 1.6)
    vessel = _segment(points, [40, -40, -10], [95, 20, -20], 2.5) & ~wall
    vessel |= _segment(points, [40, 20, 10], [80, -60, 30], 3.0) & ~wall
    sheet = np.abs(points @ np.array([0.0, 0.6, 0.8]) - 22) < 1.2
    masks = {
        "airway": wall,
        "lumen": lumen,
        "vessel": vessel,
        "outside": ~(lung | wall),
        "fissure": (sheet & lung) if fissures else np.zeros(shape, dtype=bool),
    }
    ball = np.linalg.norm(points - TARGET_LPS, axis=-1) < 5
    labels = np.zeros(shape, dtype=np.uint16)
    for name, mask in masks.items():
        labels[mask] |= np.uint16(BITS[name])
    masks |= {"lung": ~masks["outside"], "nodule": ball}
    fields = {
        name: _Field(grid, masks[key])
        for name, key in {"airway": "airway", "vessel": "vessel", "pleura": "outside"}.items()
    }
    return _Toy(
        name="Toy",
        kind="toy",
        key="0" * 64,
        folder=None,
        labels=read_only(np.asfortranarray(labels)),
        grid=grid,
        geometry=corner_geometry(grid),
        cost=None,
        has_fissures=fissures,
        fields=fields,
        lumen_depth=distance_field("lumen_depth", ~lumen, grid),
        nodules=Volume(grid=grid, array=ball) if nodule else None,
        nodule_parts=components(ball & nodule),
        vessel_border_mm=(),
        mask=lambda name: Volume(grid=grid, array=masks[name]),
        tree=_tree(trunk),
        breath_hold=None,
        motion=None,
        lobes=None,
        fissure_band=None,
        nodule_labels=None,
        findings=(),
        mask_words="the masks of Toy",
        lobe_at=lambda point_lps: "left lower lobe" if point_lps[0] > 0.0 else "",
        segment_at=lambda _point_lps: "",
        region_at=lambda point_lps: "left lower lobe" if point_lps[0] > 0.0 else "",
        branch_words=lambda branch: f"{branch} (left lower lobe)",
        warnings=("The toy is [made by hand].",),
    )


def _tree(trunk: list[Any]) -> AirwayTree:
    parent_branch, generation = [-1, 0, 0, 1, 1], [0, 1, 1, 2, 2]
    points, parents, branches, radii, start = [], [], [], [], [0]
    for number, (a, b, radius) in enumerate(trunk):
        t = np.linspace(0, 1, 30)[:, None]
        joint = -1 if number == 0 else start[parent_branch[number] + 1] - 1
        parents += [joint, *range(start[-1], start[-1] + 29)]
        points.append(np.array(a) + t * (np.array(b) - np.array(a)))
        branches += [number] * 30
        radii += [radius] * 30
        start.append(start[-1] + 30)
    places = np.concatenate(points)
    steps = np.linalg.norm(places - places[np.maximum(parents, 0)], axis=1)
    distance = np.zeros(len(places))
    for point in range(1, len(places)):
        distance[point] = distance[parents[point]] + steps[point]
    forward = [np.array(b, dtype=float) - np.array(a, dtype=float) for a, b, _ in trunk]
    return AirwayTree(
        points_lps=places,
        parent_point=np.array(parents),
        branch_of_point=np.array(branches),
        branch_start=np.array(start),
        branch_parent=np.array(parent_branch),
        generation=np.array(generation),
        radius_mm=np.array(radii),
        distance_from_root_mm=distance,
        tangents=np.array([forward[each] / np.linalg.norm(forward[each]) for each in branches]),
    )


def _pose(position: Any, forward: Any) -> np.ndarray:
    z = np.array(forward) / np.linalg.norm(forward)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    pose[:3, 3] = position
    return pose


def _advance(pose: np.ndarray, pieces: list[tuple[float, float, float]]) -> np.ndarray:
    for length, roll, curvature in pieces:
        pose = pose @ arc_transform(length, roll, curvature)
    return pose


def make_plan() -> Plan:
    """Return a plan with the scope in the left main bronchus and a needle of three arcs."""
    system = load_system("thin-scope")
    route = np.concatenate(
        [np.linspace([0, 10, 95], [0, 5, 30], 40), np.linspace([0, 5, 30], [46, 0.4, 2.4], 40)]
    )
    motion = pursued(route, 118.0, system.scope.bending_length_mm)
    tip = motion.lps_from_tip
    exit_point = tip[:3, 3] + 8 * tip[:3, 2]
    bend, (curvature, overlap) = 2.3, shared_curvatures(system)
    start = _advance(tip, [(12.0, bend, overlap), (12.0, 0.0, curvature), (0.0, -bend, 0.0)])
    arcs = tuple(
        NeedleArc(length_mm=10.0, roll_rad=roll, curvature_per_mm=k)
        for roll, k in ((0.4, 0.008), (1.0, 0.0), (-0.5, 0.006))
    )
    end = _advance(start, [(arc.length_mm, arc.roll_rad, arc.curvature_per_mm) for arc in arcs])
    return Plan(
        software_version="0",
        patient_name="Toy",
        lung_key="0" * 24,
        sources={"airway.nii": "0" * 64},
        breath_hold=None,
        system=system,
        system_fingerprint=system_fingerprint(system),
        target_lps=end[:3, 3],
        target_origin="point",
        fissures_are_obstacles=True,
        objective="inverse_clearance",
        scope=ScopeInsertion(
            lps_from_entry=motion.lps_from_entry,
            states=motion.states,
            lps_from_scope_tip=tip,
            branches=np.array([0, 1]),
            generation=1,
            length_mm=motion.length_mm,
            length_from_carina_mm=53.0,
            min_lumen_margin_mm=3.9,
            max_curvature_per_mm=motion.max_curvature_per_mm,
        ),
        tube=TubeDeployment(
            rotation_rad=bend,
            outer_insertion_mm=12.0,
            inner_insertion_mm=24.0,
            lps_from_tip=start,
            exit=WallExit(
                branch=1, point_lps=exit_point, arc_length_mm=8.0, wall_angle_rad=0.9, wall_run_mm=2.0
            ),
            lateral_sweep_mm=0.4,
            follow_the_leader_error_mm=0.1,
            shape=stated_shape(system.tubes, 12.0, 24.0),
        ),
        needle=NeedlePath(
            lps_from_start=start,
            arcs=arcs,
            end_lps=end[:3, 3],
            length_mm=30.0,
            max_angle_from_start_rad=0.14,
            accumulated_turn_rad=0.14,
        ),
        exemption=Exemption(branch=1, exit_point_lps=exit_point, needle_length_mm=5.0),
        required_clearance_mm={"outer_tube": 1.45, "inner_tube": 1.25, "needle": 1.0},
        clearance_mm={"tube": {"vessel": 2.2}, "needle": {"airway": 1.3, "vessel": 1.6, "outside": 7.0}},
        costs={"inverse_clearance": 12.34, "cost_map": 0.0, "length_mm": 30.0},
        method="atlas",
        seed=0,
        iterations=100,
        timing={"planning_s": 0.3},
    )


@pytest.fixture(scope="session")
def toy_lung() -> Any:
    return make_lung()


@pytest.fixture(scope="session")
def bare_lung() -> Any:
    """A patient without fissures and nodules."""
    return make_lung(fissures=False, nodule=False)


@pytest.fixture(scope="session")
def toy_plan() -> Plan:
    return make_plan()
