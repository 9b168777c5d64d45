"""Cases of motions: the scope in the lumen, and devices in the phases of the breath that are proved."""

import math

import numpy as np

from anatomy.base.typed import Float, Labels
from anatomy.grid import Grid
from anatomy.motion.motion import LEFT, Motion
from anatomy.poses import pose, poses_on_arc
from anatomy.structures import AIRWAY, LUMEN, OBSTACLES, VESSEL
from lungaccess.judging.selftest import scenes
from lungaccess.uncertainty.breathing.kernels import rules
from lungaccess.uncertainty.breathing.kernels.rigid import Rigid
from lungaccess.uncertainty.breathing.kernels.window import MOST_LEAVES, divide
from lungaccess.uncertainty.breathing.window import breath_of, carrier
from stages.scope import Bronchoscope, MotionProver, ScopeMotion

NODE_MM, MASKS_PHASE = 5.0, 0.3
TOLERANCE_MM, HOLE_MM = 1.5, 0.6
KEPT_MM = 0.6
SECTIONS = np.array([
    (0, 6, rules.IN_LUMEN, KEPT_MM, 0.3), (7, 14, rules.IN_WALL, KEPT_MM, 0.3),
    (15, 19, rules.TUBE, KEPT_MM, 0.3), (20, 30, rules.NEEDLE, KEPT_MM, 0.3),
], dtype=np.float64)  # fmt: skip
"""First and last point, rule, clearance and radius in mm; points are 0.5 mm apart, two at each joint."""
ARC_MM = np.concatenate([np.arange(0.0, 3.1, 0.5), np.arange(3.0, 6.6, 0.5), np.arange(6.5, 8.6, 0.5),
                         np.arange(8.5, 13.6, 0.5)])  # fmt: skip
SHARES = np.linspace(0.0, 1.0, 3)
"""Phases of a stretch that are looked at."""
STEPS = 20
"""To the place of a moved voxel that is nearest to a device: the rest shrinks to a third or less in each."""
FAR_MM = 4.0
"""Voxels farther from the devices in the masks come near in no phase."""


def windows(rng: scenes.Random) -> scenes.Case:
    """Draw a breathing tissue; a clear stretch is so in sampled phases, and a blocked one is not."""
    labels, grid = scenes.empty_labels((-7.0, -7.0, -18.0), (7.0, 7.0, 3.0), 1.0)
    ahead = np.array([*rng.uniform(-0.15, 0.15, 2), -1.0])
    points = np.array([0.0, 0.0, -1.0]) + ARC_MM[:, None] * ahead / np.linalg.norm(ahead)
    for _ in range(5):
        place = points[int(rng.integers(16, 31))] + np.array([*rng.uniform(1.4, 2.2) * _unit2(rng), 0.0])
        labels[scenes.near_segment(grid, place, place + scenes.unit(rng), 0.5)] = VESSEL
    scenes.draw_airway(labels, grid, (0.0, 0.0, 0.0), (0.0, 0.0, -3.0), 2.0)
    lung, motion = (
        scenes.lung_of(labels, grid, scenes.line_tree((0, 0, 0), (0, 0, -3.0), 2.0)),
        breathing(rng),
    )
    target = points[-1] + 0.5 * scenes.unit(rng)
    field, depth = lung.obstacle_field(with_fissures=False), lung.lumen_depth
    leaves, rigid = np.zeros((MOST_LEAVES, 5)), carrier(motion, points[0], LEFT)
    count = divide(
        rules.Tissue(
            field.corners, lung.labels, field.geometry, int(OBSTACLES), depth.corners, depth.geometry, 0
        ),
        breath_of(motion, LEFT), rigid, points, ARC_MM, SECTIONS, target, TOLERANCE_MM,
        points[8], HOLE_MM, 1.0, MASKS_PHASE, (0.0, 1.0), True, leaves,
    )  # fmt: skip
    leaves = leaves[:count]

    def contradiction() -> str:
        wide = leaves[np.argsort(leaves[:, 0] - leaves[:, 1], kind="stable")][:12]
        for begin, end, state, _reason, _at in wide:
            for phase in begin + SHARES * (end - begin):
                spare = _spare_mm(
                    lung.labels, grid, motion, rigid, points, target, float(phase) - MASKS_PHASE
                )
                # How much farther than the nearest place of a voxel what these steps find may be.
                if spare < -1e-3 if state == rules.CLEAR else state == rules.BLOCKED and spare > 0.05:
                    said = f"phases {begin:.4f} to {end:.4f} in state {state:.0f}"
                    return f"{said}; {spare:.4f} mm spare at {phase:.4f}"
        return ""

    return scenes.Case(answers=leaves.ravel(), contradiction=contradiction)


def _unit2(rng: scenes.Random) -> Float:
    """Return a random direction `(2,)`."""
    around = rng.uniform(0.0, 2.0 * np.pi)
    return np.array([np.cos(around), np.sin(around)])


def breathing(rng: scenes.Random) -> Motion:
    """Return a motion of some millimetres that stretches and turns tissue, here more and there less."""
    grid = Grid.from_spacing((6, 6, 7), (NODE_MM,) * 3, (-12.5, -12.5, -22.5))
    places = grid.lps(np.moveaxis(np.indices(grid.shape), 0, -1))
    nodes = places @ rng.uniform(-0.2, 0.2, (3, 3)) + rng.uniform(-4.0, 4.0, 3)
    nodes += rng.uniform(-0.1, 0.1, nodes.shape)
    return Motion(
        grid=grid, nodes=np.stack([nodes, nodes]), middle_x_mm=-100.0, masks_phase=MASKS_PHASE, amplitude=1.0,
        source="drawn", warning_only=False, figures={},
    )  # fmt: skip


def _displaced(motion: Motion, points: Float) -> Float:
    """Return the displacements `(N, 3)` of places of the masks, by other code than the kernels'."""
    from scipy.ndimage import map_coordinates

    at = ((points - motion.grid.lps_from_ijk[:3, 3]) / NODE_MM).T
    nodes = motion.nodes[LEFT]
    return np.stack([map_coordinates(nodes[..., n], at, order=1, mode="nearest") for n in range(3)], axis=1)


def _spare_mm(
    labels: Labels, grid: Grid, motion: Motion, rigid: Rigid, points: Float, target: Float, share: float
) -> float:
    """Return by how much all rules are kept in a phase, by samples of the moved voxels."""
    from scipy.linalg import polar

    def rides(place: Float) -> Float:
        turn = polar(np.eye(3) + share * rigid.gradient)[0]
        return np.asarray(rigid.centre + share * rigid.displacement + (place - rigid.centre) @ turn.T)

    def miss_mm(place: Float, of: Float) -> float:
        return float(np.linalg.norm(rides(place) - of - share * _displaced(motion, of[None])[0]))

    def least_mm(first: int, bits: int, kept_mm: float, last: int | None = None) -> float:
        voxels = grid.lps(np.argwhere((labels & bits) != 0))
        at, voxel = np.nonzero(np.linalg.norm(points[first:last, None] - voxels, axis=-1) < FAR_MM)
        nearest = voxels[voxel]
        # Towards the device, by what is left, and back into the box, again and again.
        for _ in range(STEPS):
            left = devices[first:last][at] - nearest - share * _displaced(motion, nearest)
            nearest = np.clip(nearest + left, voxels[voxel] - 0.5, voxels[voxel] + 0.5)
        left = devices[first:last][at] - nearest - share * _displaced(motion, nearest)
        return float(np.linalg.norm(left, axis=1).min(initial=FAR_MM)) - kept_mm

    devices = rides(points)
    inside = devices[:7].copy()
    for _ in range(60):
        inside = devices[:7] - share * _displaced(motion, inside)
    return min(
        TOLERANCE_MM - miss_mm(points[-1], target), HOLE_MM - miss_mm(points[8], points[8]),
        2.0 * rules.CORNER_MM - float(scenes.true_distances(labels, grid, inside, LUMEN).max()),
        least_mm(7, VESSEL, KEPT_MM), least_mm(20, AIRWAY, KEPT_MM), least_mm(15, LUMEN, 0.0, 20),
    )  # fmt: skip


SCOPE = Bronchoscope(
    name="selftest", outer_diameter_mm=2.0, channel_diameter_mm=1.0, lumen_margin_mm=0.1, bend_up_deg=180.0,
    bend_down_deg=60.0, bending_length_mm=6.0, min_bending_radius_mm=4.0, min_shaft_radius_mm=4.0,
    bending_stiffness_n_mm2=1000.0,
)  # fmt: skip
ENTRY = pose([0.0, 0.0, -1.0], [0.0, 0.0, -1.0])
NEEDED_MM = SCOPE.radius_mm + SCOPE.lumen_margin_mm
TIMES, PLACES = 60, 25
"""Places of a change in place that are sampled: states, and points of the section in each."""


def motions(rng: scenes.Random) -> scenes.Case:
    """Draw motions beside a septum; what is proved free is so in all samples, and nearly all else is not."""
    labels, grid = scenes.empty_labels((-6.5, -6.5, -14.0), (6.5, 6.5, 6.0), 1.0)
    scenes.draw_airway(labels, grid, (0.0, 0.0, 0.0), (0.0, 0.0, -8.0), 4.5)
    labels[:, 6, :7] &= ~np.uint16(LUMEN)
    lung = scenes.lung_of(labels, grid, scenes.line_tree((0.0, 0.0, 0.0), (0.0, 0.0, -8.0), 4.5))
    prover, drawn, rooms = MotionProver(lung, SCOPE), [], []
    for _ in range(5):
        entry = scenes.tilted(ENTRY, 0.2 * scenes.unit(rng), rng.uniform(0.0, 0.1), 0.0)
        states = np.zeros((4, 3))
        states[2:, 0] = rng.uniform(0.0, 0.3)
        states[:, 1:] = rng.uniform((-0.4, 0.65), (0.4, 0.85), (4, 2))
        states[:, 2] *= rng.choice((-1.0, 1.0), 4)
        states[2, 1:] = states[1, 1:]
        motion = ScopeMotion(lps_from_entry=entry, states=states, bending_length_mm=SCOPE.bending_length_mm)
        # With the longest steps the bounds between places and states carry the whole proof.
        found = prover.prove(motion), prover.prove(motion, turn_mm=math.inf, step_mm=math.inf)
        drawn.append(motion)
        rooms.append([each if isinstance(each, float) else -1.0 for each in found])

    def contradiction() -> str:
        wall = np.where(labels & LUMEN, 0, AIRWAY).astype(np.uint16)
        for motion, (margin, room) in zip(drawn, rooms, strict=True):
            least = float(scenes.true_distances(wall, grid, places(motion), AIRWAY).min()) - NEEDED_MM
            proved = max(margin, room)
            # The proof gives up this much near a wall at most: half of a step, and of a part of a change.
            if proved > max(least + scenes.ROUNDING_MM, -0.5) or (margin < 0.0 and least > 0.15):
                return f"room {margin:.4f} mm, by long steps {room:.4f} mm; in samples {least:.4f} mm"
        return ""

    return scenes.Case(answers=np.array(rooms).ravel(), contradiction=contradiction)


def places(motion: ScopeMotion) -> Float:
    """Return places `(N, 3)` of the body's axis at many times of a motion, by other code than the proof's."""
    base, found = motion.lps_from_entry, []
    length = motion.bending_length_mm
    for before, after in zip(motion.states[:-1], motion.states[1:], strict=True):
        ahead = float(after[0] - before[0])
        for share in np.linspace(0.0, 1.0, TIMES) if ahead == 0.0 else (0.0,):
            twist, bend = before[1:] + share * (after[1:] - before[1:])
            arcs = np.linspace(0.0, length + ahead, PLACES)
            found.append(poses_on_arc(base, twist, bend / length, arcs)[:, :3, 3])
        if ahead > 0.0:
            moved = poses_on_arc(base, before[1], before[2] / length, np.array([ahead]))[0]
            base = moved @ poses_on_arc(np.eye(4), -before[1], 0.0, np.array([0.0]))[0]
    return np.concatenate(found)
