"""Bronchoscopes that do not move as stated, that cannot, or that run into the wall on the way."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from anatomy import structures
from anatomy.base.errors import SettingsError
from anatomy.base.settings import override
from anatomy.base.typed import Float
from experiments.support.mutants.draws import Rng, far, rotation, signed
from experiments.support.mutants.mutant import Case, Mutant, Mutation, changed, with_system
from lungaccess.plans.insertion import scope_motion

SEEN_MM, SEEN_RAD = 2e-3, 2e-4
"""Poses that differ by more are told apart."""
ON_AXIS_MM = 0.02
"""A motion may begin on the axis of the trachea."""
FORWARD = np.array([0.0, 0.0, 1.0])


def with_states(case: Case, states: Float) -> Mutant | None:
    """Return the plan with other states, None if their tip is where it was and they are as possible."""
    plan = changed(case.plan, scope__states=states)
    steps = np.diff(states, axis=0)
    turns = (np.abs(steps[:, 1:]) > 1e-6).any(axis=1)
    possible = (steps[:, 0] >= 0.0).all() and not (turns & (steps[:, 0] > 1e-6)).any()
    same_length = abs(float(states[-1, 0] - case.plan.scope.states[-1, 0])) < SEEN_MM
    apart = scope_motion(plan).lps_from_tip - case.plan.scope.lps_from_scope_tip
    same = np.abs(apart[:3, 3]).max() < SEEN_MM and np.abs(apart[:3, :3]).max() < SEEN_RAD
    return None if possible and same and same_length else Mutant(plan=plan)


def state_edited(case: Case, rng: Rng) -> Mutant | None:
    """One state, or all from one on, with another advance, twist or bend."""
    states = case.plan.scope.states.copy()
    n, column = int(rng.integers(len(states))), int(rng.integers(3))
    which = slice(n, None) if rng.integers(2) else slice(n, n + 1)
    states[which, column] += signed(rng, 1e-3, 10.0 if column == 0 else 1.5)
    return with_states(case, states)


def twist_dropped(case: Case, rng: Rng) -> Mutant | None:
    """All twists are 0, or have the other sign, or are in degrees."""
    states = case.plan.scope.states.copy()
    states[:, 1] *= float(rng.choice([0.0, -1.0, np.rad2deg(1.0)]))
    return with_states(case, states)


def bends_edited(case: Case, rng: Rng) -> Mutant | None:
    """All bends larger, smaller, or the other way."""
    states = case.plan.scope.states.copy()
    states[:, 2] *= float(rng.choice([-1.0, 0.0, rng.uniform(0.5, 0.98), rng.uniform(1.02, 2.0)]))
    return with_states(case, states)


def states_shuffled(case: Case, rng: Rng) -> Mutant | None:
    """States exchanged, turned round, or lost."""
    states = case.plan.scope.states
    kind = int(rng.integers(4))
    order = np.arange(len(states))
    if kind == 0:
        order = order[::-1]
    elif kind == 1:
        a, b = rng.integers(len(states), size=2)
        order[[a, b]] = order[[b, a]]
    elif kind == 2:
        order = rng.permutation(order)
    else:
        order = np.sort(rng.choice(order, size=max(len(order) // 2, 1), replace=False))
    return with_states(case, states[order])


def jumps(case: Case, rng: Rng) -> Mutant | None:
    """Turns in place are left out, so that the scope advances and turns at once."""
    states = case.plan.scope.states
    steps = np.diff(states, axis=0)
    forward = steps[:, 0] > 1e-6
    corners = np.flatnonzero(forward[:-1] != forward[1:]) + 1
    if not len(corners):
        return None
    return with_states(case, np.delete(states, int(rng.choice(corners)), axis=0))


def draws_back(case: Case, rng: Rng) -> Mutant | None:
    """The scope draws back a little on the way, which lays no shaft."""
    states = case.plan.scope.states
    n = int(rng.integers(len(states)))
    back = states[n] - [far(rng, 1e-3, 10.0), 0.0, 0.0]
    return with_states(case, np.insert(states, n + 1, [back, states[n]], axis=0))


def excursion_into_the_wall(case: Case, rng: Rng) -> Mutant | None:
    """On the way the section bends into the wall and back: before and behind all is as it was."""
    states = case.plan.scope.states
    n = int(rng.integers(len(states)))
    aside = states[n] + [0.0, rng.uniform(-np.pi, np.pi), 0.0]
    low, high = case.plan.system.scope.bends_rad
    aside[2] = rng.uniform(low, high)
    until = changed(case.plan, scope__states=np.append(states[: n + 1], [aside], axis=0))
    section = scope_motion(until).body(0.2)[-int(case.plan.system.scope.bending_length_mm / 0.2) :, :3, 3]
    if (labels_at(case, section) & structures.LUMEN).all():
        return None
    return Mutant(plan=changed(case.plan, scope__states=np.insert(states, n + 1, [aside, states[n]], axis=0)))


def labels_at(case: Case, points: Float) -> Any:
    """Return the labels of the voxels that hold points, which lie in the image."""
    index = np.rint(case.lung.grid.ijk(points)).astype(np.int64)
    index = np.clip(index, 0, np.array(case.lung.labels.shape) - 1)
    return case.lung.labels[tuple(index.T)]


def tip_rolled_with_its_tubes(case: Case, rng: Rng) -> Mutant | None:
    """The tip has another roll than the motion leaves, and the tubes turn back by as much."""
    roll = signed(rng, 5e-4, np.pi)
    pose = case.plan.scope.lps_from_scope_tip.copy()
    pose[:3, :3] = pose[:3, :3] @ rotation(FORWARD, roll)
    turned = case.plan.tube.rotation_rad - roll
    return Mutant(plan=changed(case.plan, scope__lps_from_scope_tip=pose, tube__rotation_rad=turned))


def begins_deep_in_the_airway(case: Case, rng: Rng) -> Mutant | None:
    """The first part of the way is left out; all that is stated of the rest is true but its lengths."""
    scope, motion = case.plan.scope, scope_motion(case.plan)
    n = int(rng.integers(1, len(scope.states)))
    before = replace(motion, states=motion.states[: n + 1])
    gone = float(scope.states[n, 0])
    twist, bend = scope.states[n, 1:]
    base = before.lps_from_tip @ np.linalg.inv(_section(twist, bend, motion.bending_length_mm))
    if np.linalg.norm(case.lung.tree.points_lps - base[:3, 3], axis=1).min() < ON_AXIS_MM:
        return None
    edits: dict[str, Any] = {
        "scope__lps_from_entry": base,
        "scope__states": scope.states[n:] - [gone, 0.0, 0.0],
        "scope__length_mm": scope.length_mm - gone,
    }
    return Mutant(plan=changed(case.plan, **edits))


def _section(twist: float, bend: float, length_mm: float) -> Float:
    """Return the tip in the frame of the base, whose roll the twist is not."""
    pose = np.eye(4)
    pose[:3, :3] = rotation(FORWARD, twist) @ rotation(np.array([0.0, 1.0, 0.0]), bend)
    ahead = np.array([0.5 * bend * np.sinc(0.5 * bend / np.pi) ** 2, 0.0, np.sinc(bend / np.pi)])
    pose[:3, 3] = length_mm * rotation(FORWARD, twist) @ ahead
    return pose


def scope_of_another_kind(case: Case, rng: Rng) -> Mutant | None:
    """Another length of the bending section, or limits that the motion breaks; the name is its own."""
    scope = case.plan.system.scope
    most = {each.name: each.value or 0.0 for each in case.report.findings if each.name.startswith("scope.")}
    factor = far(rng, 1.02, 3.0)
    edits = {
        "bending_length_mm": scope.bending_length_mm * float(rng.choice([factor, 1.0 / factor])),
        "bend_up_deg": np.rad2deg(most["scope.bend.up"]) / factor,
        "bend_down_deg": np.rad2deg(most["scope.bend.down"]) / factor,
        "min_bending_radius_mm": factor / max(most["scope.bend.radius"], 1e-9),
        "min_shaft_radius_mm": factor / max(most["scope.shaft.radius"], 1e-9),
    }
    key = str(rng.choice(list(edits)))
    if key.startswith("bend_") and edits[key] < 0.1:
        return None
    try:
        system = override(case.plan.system, {f"scope.{key}": float(edits[key]), "name": "own"})
    except SettingsError:
        return None
    return Mutant(plan=with_system(case.plan, system))


def scope_statement_edited(case: Case, rng: Rng) -> Mutant | None:
    """A number about the scope that is not so."""
    scope, tree = case.plan.scope, case.lung.tree
    found = next((each for each in case.report.findings if each.name == "scope.margin"), None)
    if found is None or found.value is None:
        return None
    edits: dict[str, Any] = {
        "scope__min_lumen_margin_mm": scope.min_lumen_margin_mm - found.value + far(rng, 0.1, 10.0),
        "scope__branches": other_branches(scope.branches, tree, rng),
        "scope__generation": scope.generation + int(rng.choice([-1, 1, 2])),
        "scope__length_mm": scope.length_mm + signed(rng, 0.01, 50.0),
        "scope__length_from_carina_mm": scope.length_from_carina_mm + signed(rng, 0.3, 50.0),
        "scope__max_curvature_per_mm": scope.max_curvature_per_mm + signed(rng, 1e-6, 0.1),
    }
    key = str(rng.choice(list(edits)))
    return Mutant(plan=changed(case.plan, **{key: edits[key]}))


def other_branches(branches: Any, tree: Any, rng: Rng) -> Any:
    """Return branches without one, with one more than once, or with a far one at the end."""
    n = int(rng.integers(len(branches)))
    last = int(branches[-1])
    parent = int(tree.branch_parent[last])
    kin = {last, parent, *tree.children(last).tolist(), *tree.children(max(parent, 0)).tolist()}
    strangers = np.setdiff1d(np.arange(tree.n_branches), sorted(kin))
    choices = [np.insert(branches, n, branches[n])]
    if len(branches) > 1 and n < len(branches) - 1:
        choices.append(np.delete(branches, n))
    if len(strangers):
        choices.append(np.append(branches[:-1], rng.choice(strangers)))
    return choices[int(rng.integers(len(choices)))]


MUTATIONS: tuple[Mutation, ...] = (
    state_edited, twist_dropped, bends_edited, states_shuffled, jumps, draws_back, excursion_into_the_wall,
    tip_rolled_with_its_tubes, begins_deep_in_the_airway, scope_of_another_kind, scope_statement_edited,
)  # fmt: skip
