"""Cases of the proof that a motion of the bronchoscope touches no wall."""

import math

import numpy as np

from anatomy.base.typed import Float
from anatomy.poses import pose, poses_on_arc
from anatomy.structures import AIRWAY, LUMEN
from lungaccess.judging.selftest import scenes
from stages.scope import Bronchoscope, MotionProver, ScopeMotion

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
