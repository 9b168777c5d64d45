"""Stages and plans that are not in their place."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from anatomy.base.typed import Float
from experiments.support.mutants.draws import Rng, direction, far, rotation, signed
from experiments.support.mutants.motion import end_of
from experiments.support.mutants.mutant import Case, Mutant, Mutation, changed, of_needle
from lungaccess.plans.parts import NeedleArc
from lungaccess.plans.plan import Plan

POSES = ["scope__lps_from_entry", "scope__lps_from_scope_tip", "tube__lps_from_tip", "needle__lps_from_start"]
PIECES = ("scope", "tube", "needle", "exit", "target")


def moved(plan: Plan, pieces: tuple[str, ...], matrix: Float, turn: float = 1.0) -> Plan:
    """Apply a map of space `(4, 4)` to some pieces; `turn` multiplies rotations and rolls."""
    keep_handed = np.diag([1.0, turn, 1.0, 1.0])

    def point(points: Float) -> Float:
        return np.asarray(points @ matrix[:3, :3].T + matrix[:3, 3])

    def pose(frame: Float) -> Float:
        return np.asarray(matrix @ frame @ keep_handed)

    scope, tube, needle = plan.scope, plan.tube, plan.needle
    edits: dict[str, dict[str, Any]] = {
        "scope": {
            "scope__lps_from_entry": pose(scope.lps_from_entry),
            "scope__states": scope.states * [1.0, turn, 1.0],
            "scope__lps_from_scope_tip": pose(scope.lps_from_scope_tip),
        },
        "tube": {
            "tube__lps_from_tip": pose(tube.lps_from_tip),
            "tube__rotation_rad": turn * tube.rotation_rad,
        },
        "exit": {
            "tube__exit__point_lps": point(tube.exit.point_lps),
            "exemption__exit_point_lps": point(plan.exemption.exit_point_lps),
        },
        "target": {"target_lps": point(plan.target_lps)},
    }
    if needle is not None:
        edits["needle"] = {
            "needle__lps_from_start": pose(needle.lps_from_start),
            "needle__end_lps": point(needle.end_lps),
            "needle__arcs": tuple(replace(arc, roll_rad=turn * arc.roll_rad) for arc in needle.arcs),
        }
    return changed(plan, **{key: value for piece in pieces for key, value in edits.get(piece, {}).items()})


def some_pieces(plan: Plan, rng: Rng) -> tuple[str, ...]:
    """Return one stage, or all with or without the target."""
    last = [("target",)] if plan.needle is None else [("needle",), ("needle", "target")]
    choices = [("scope",), ("tube",), ("tube", "exit"), *last, PIECES[:4], PIECES]
    return choices[int(rng.integers(len(choices)))]


def shifted_by_a_voxel(case: Case, rng: Rng) -> Mutant | None:
    """A stage, or all, one voxel beside its place."""
    matrix = np.eye(4)
    axis = int(rng.integers(3))
    matrix[:3, 3] = float(rng.choice([-1.0, 1.0])) * case.lung.grid.lps_from_ijk[:3, axis]
    return Mutant(plan=moved(case.plan, some_pieces(case.plan, rng), matrix))


def mirrored(case: Case, rng: Rng) -> Mutant | None:
    """A stage, or all, with left and right, front and back, or head and feet exchanged: RAS taken for LPS."""
    matrix = np.eye(4)
    axis = int(rng.integers(3))
    matrix[axis, axis] = -1.0
    about = rng.choice(["origin", "carina"])
    if about == "carina":
        matrix[axis, 3] = 2.0 * case.lung.tree.carina_lps[axis]
    return Mutant(plan=moved(case.plan, some_pieces(case.plan, rng), matrix, turn=-1.0))


def rotated(case: Case, rng: Rng) -> Mutant | None:
    """A stage, or all, turned about an axis through the carina."""
    turn = rotation(direction(rng), float(np.deg2rad(signed(rng, 0.3, 180.0))))
    matrix = np.eye(4)
    matrix[:3, :3] = turn
    matrix[:3, 3] = case.lung.tree.carina_lps - turn @ case.lung.tree.carina_lps
    return Mutant(plan=moved(case.plan, some_pieces(case.plan, rng), matrix))


@of_needle
def other_units(case: Case, rng: Rng) -> Mutant | None:
    """Lengths in cm, angles in degrees, curvatures per cm or per m, or x and y with the signs of RAS."""
    plan, tube, needle = case.plan, case.plan.tube, case.plan.needle

    def arcs(length: float, roll: float, curvature: float) -> tuple[NeedleArc, ...]:
        return tuple(
            NeedleArc(
                length_mm=length * a.length_mm,
                roll_rad=roll * a.roll_rad,
                curvature_per_mm=curvature * a.curvature_per_mm,
            )
            for a in needle.arcs
        )

    degrees = float(np.rad2deg(1.0))
    bent = max(a.curvature_per_mm * a.length_mm for a in needle.arcs) > 0.01
    edits: list[dict[str, Any]] = [
        {"needle__arcs": arcs(0.1, 1.0, 1.0)},
        {"needle__arcs": arcs(0.1, 1.0, 10.0), "needle__length_mm": 0.1 * needle.length_mm},
        {"tube__inner_insertion_mm": 0.1 * tube.inner_insertion_mm},
        {"scope__states": plan.scope.states * [0.1, 1.0, 1.0]},
        {"target_lps": plan.target_lps * [-1.0, -1.0, 1.0]},
        {"scope__length_mm": 0.1 * plan.scope.length_mm},
    ]
    if bent:
        edits += [{"needle__arcs": arcs(1.0, 1.0, 10.0)}, {"needle__arcs": arcs(1.0, 1.0, 1000.0)}]
    rolled = arcs(1.0, degrees, 1.0)
    if np.linalg.norm(end_of(plan, rolled) - end_of(plan, needle.arcs)) > 0.01:
        edits.append({"needle__arcs": rolled})
    if abs(np.sin(0.5 * (degrees - 1.0) * tube.rotation_rad)) > 0.01:
        edits.append({"tube__rotation_rad": degrees * tube.rotation_rad})
    return Mutant(plan=changed(plan, **edits[int(rng.integers(len(edits)))]))


def pose_edited(case: Case, rng: Rng) -> Mutant | None:
    """A pose turned by a few degrees, rolled, moved, inverted, mirrored or scaled."""
    name = str(rng.choice(POSES if case.plan.needle is not None else POSES[:3]))
    stage, field = name.split("__")
    pose = getattr(getattr(case.plan, stage), field).copy()
    kind = int(rng.integers(6))
    if kind == 0:
        aside = np.append(rng.standard_normal(2), 0.0)
        pose[:3, :3] = pose[:3, :3] @ rotation(
            aside / np.linalg.norm(aside), np.deg2rad(signed(rng, 0.05, 90.0))
        )
    elif kind == 1:
        pose[:3, :3] = pose[:3, :3] @ rotation(np.array([0.0, 0.0, 1.0]), np.deg2rad(signed(rng, 0.05, 90.0)))
    elif kind == 2:
        pose[:3, 3] += far(rng, 0.01, 20.0) * direction(rng)
    elif kind == 3:
        pose = np.linalg.inv(pose)
    elif kind == 4:
        pose[:3, int(rng.integers(3))] *= -1.0
    else:
        pose[:3, :3] *= 1.0 + signed(rng, 1e-4, 0.5)
    if np.abs(pose - getattr(getattr(case.plan, stage), field)).max() < 1e-6:
        return None
    return Mutant(plan=changed(case.plan, **{name: pose}))


def stage_of_another_plan(case: Case, rng: Rng) -> Mutant | None:
    """Scope, tubes, needle or exemption of another plan of the same lung."""
    both = case.plan.needle is not None and case.other.needle is not None
    name = str(rng.choice(["scope", "tube", "needle"] if both else ["scope", "tube"]))
    pose = {"scope": "lps_from_scope_tip", "tube": "lps_from_tip", "needle": "lps_from_start"}[name]
    mine, theirs = getattr(case.plan, name), getattr(case.other, name)
    if np.abs(getattr(mine, pose) - getattr(theirs, pose)).max() < 0.01:
        return None
    return Mutant(plan=changed(case.plan, **{name: theirs}))


MUTATIONS: tuple[Mutation, ...] = (
    shifted_by_a_voxel, mirrored, rotated, other_units, pose_edited,
    stage_of_another_plan,
)  # fmt: skip
