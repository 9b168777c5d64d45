"""Cases of the tubes' proof, of the cost bound, and of proofs that no deployment reaches a target."""

import math

import numpy as np
from scipy.spatial.transform import Rotation

from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from anatomy.fields import distance_corners
from anatomy.kernels.field import UNITS_PER_MM
from anatomy.lung import Lung
from anatomy.poses import pose
from anatomy.structures import LUMEN, OBSTACLES, OUTSIDE, VESSEL
from lungaccess.judging.selftest import scenes
from lungaccess.planning.coupled.cost_bound import bound_environment
from lungaccess.planning.coupled.kernels import box_queue, deployment_box
from lungaccess.planning.coupled.kernels.box_of_tubes import HALF, INNER, ROTATION
from lungaccess.planning.reachability.kernels import deployment_boxes as reach_boxes
from lungaccess.planning.reachability.kernels import unreachable
from lungaccess.planning.reachability.kernels.blocked import ProofEnvironment
from stages.needle import ArcPath, Needle, NeedleEnvironment, backward_reach, environment_of_labels
from stages.needle.kernels import CLEARANCE_FLOOR_MM
from stages.tube import deployed, kernels, tube_environment
from stages.tube.kernels import TubeEnvironment

NEEDLE = Needle(
    diameter_mm=0.6, max_curvature_per_mm=0.15, max_length_mm=10.0, exit_exemption_mm=2.0,
    max_angle_from_start_deg=90.0, max_accumulated_turn_deg=180.0,
)  # fmt: skip
REQUIRED_MM = 0.6
TUBES = np.zeros(kernels.N_TUBES)
for _column, _value in {
    kernels.OVERLAP_CURVATURE: 0.06, kernels.INNER_CURVATURE: 0.1, kernels.CURVED_LENGTH: 8.0,
    kernels.OUTER_RADIUS: 0.4, kernels.INNER_RADIUS: 0.3, kernels.MARGIN: 0.3, kernels.MAX_SWEEP: 1.0,
    kernels.MIN_WALL_ANGLE: 0.1, kernels.MAX_EXTENSION: 10.0, kernels.MAX_PROTRUSION: 10.0,
    kernels.MAX_WALL_RUN: 6.0,
}.items():  # fmt: skip
    TUBES[_column] = _value
DESIGN = kernels.DesignArrays(
    stiffness=np.array([[0.6, 0.6], [0.4, 0.4]]), lengths=np.array([20.0, 10.0]),
    bends=np.array([[0.0, 12.0, 20.0, 0.1, 0.0, 1.0]]), radii=np.array([0.3, 0.4]), strained=np.zeros(2),
    turned=np.zeros(2, dtype=np.bool_), limits=np.array([0.075, 2.0, 0.5 * math.pi, 10.0, 1.0, 1.0]),
    planar=TUBES,
)  # fmt: skip
"""The same tubes as the mechanics take them: the outer one is stiff enough to leave 0.6 of the curvature."""
REFUSED = kernels.N_REASONS
"""Stands for a reason where the tubes would sweep too far."""
FRAME = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
"""X, Y and the axis of the airway, which leads down from the origin."""
WEIGHTS = 1.0, 0.1
"""The weights of a path's integral of 1 / clearance, and of its length."""
HALVES = np.array([0.3, 0.3, 1.5, 4.0, 4.0, 0.5, 0.5, 0.5])
"""Half widths of a large box of deployments, rad and mm."""


@frozen_record
class Reaching:
    """A lung, accepted tubes in it, and a clear path of the needle from them to a target.

    `values` (8,) are the two parts of the tip's direction, the rotation, both insertions, and the place along
    FRAME, as in `lungaccess.planning.reachability.kernels.deployment_boxes`; `base` (9,) is point, direction
    and +x of the scope's tip.
    """

    lung: Lung
    tubes: TubeEnvironment
    needle: NeedleEnvironment
    values: Float
    base: Float
    path: ArcPath

    @property
    def target(self) -> Float:
        """Where the path ends."""
        return np.array(self.path.frames()[-1][:3, 3])


def _drawn_lung(rng: scenes.Random) -> Lung:
    """Return a box of 20 mm with an airway that ends in tissue, and vessels around its end."""
    labels, grid = scenes.empty_labels((-9.0, -9.0, -20.0), (9.0, 9.0, 3.0), 1.0)
    for _ in range(8):
        place = np.array([*rng.uniform(-6.0, 6.0, 2), rng.uniform(-17.0, -6.0)])
        labels[scenes.near_segment(grid, place, place + 2.0 * scenes.unit(rng), 0.6)] = VESSEL
    ends = (0.0, 0.0, 0.0), (0.0, 0.0, -4.0)
    scenes.draw_airway(labels, grid, *ends, 2.2)
    return scenes.lung_of(labels, grid, scenes.line_tree(*ends, 2.2))


def _drawn_tubes(rng: scenes.Random, environment: TubeEnvironment) -> tuple[Float, Float, int, Float, Float]:
    """Return values and base of a deployment, why it is refused, trace and tip; see `Reaching`."""
    inner = rng.uniform(4.0, 9.9)
    place = np.array([*rng.uniform(-0.3, 0.3, 2), rng.uniform(1.0, 3.0)])
    values = np.array(
        [*rng.normal(0.0, 0.15, 2), rng.uniform(-3.0, 3.0), rng.uniform(0, inner), inner, *place]
    )
    turned = Rotation.from_rotvec(values[0] * FRAME[0] + values[1] * FRAME[1]).as_matrix()
    base = np.concatenate([place @ FRAME, turned @ FRAME[2], turned @ FRAME[0]])
    normal = math.cos(values[2]) * base[6:] + math.sin(values[2]) * (turned @ FRAME[1])
    trace, tip = np.zeros(kernels.N_TRACE), np.zeros(9)
    shape = deployed(DESIGN, values[4:2:-1], np.zeros(2))
    reason = REFUSED
    if shape is not None:
        arcs, beside = shape.arcs[: shape.number[0]], float(shape.result[kernels.SWEEP])
        reason = kernels.validate_arcs(environment, TUBES, base[:6], normal, arcs, beside, trace, tip)
    return values, base, int(reason), trace, np.concatenate([tip, normal])


def tubes(rng: scenes.Random) -> scenes.Case:
    """Draw deployments; samples of an accepted one, beyond the wall, are clear of all but its branch."""
    lung = _drawn_lung(rng)
    environment = tube_environment(lung, with_fissures=False)
    drawn = [_drawn_tubes(rng, environment) for _ in range(12)]

    def contradiction() -> str:
        for values, base, reason, trace, tip in drawn:
            if reason != kernels.ACCEPTED:
                continue
            left, (outer, inner) = float(trace[kernels.LEFT_AT]), values[3:5]
            at = np.arange(left, inner, 0.05)
            points = centreline(base[:3], base[3:6], tip[9:], outer, inner, at)
            needed = np.where(at <= outer, TUBES[kernels.OUTER_RADIUS], TUBES[kernels.INNER_RADIUS])
            gap = (
                scenes.true_distances(lung.labels, lung.grid, points, OBSTACLES, 0)
                - needed
                - TUBES[kernels.MARGIN]
            )
            out = scenes.true_distances(lung.labels, lung.grid, points[at > left + 1.0], LUMEN)
            if gap.min() < -scenes.ROUNDING_MM or out.min(initial=1.0) <= 0.0:
                return f"accepted with a clearance of {gap.min():.4f} mm beyond what is required, in samples"
        return ""

    answers = [np.concatenate([[each[2]], each[3], each[4][:9]]) for each in drawn]
    return scenes.Case(answers=np.concatenate(answers), contradiction=contradiction)


def centreline(base: Float, forward: Float, normal: Float, outer: float, inner: float, at: Float) -> Float:
    """Return places of deployed tubes at arc lengths, summed up from their curvature in fine steps."""
    fine = np.linspace(0.0, inner, 2001)
    middle = 0.5 * (fine[1:] + fine[:-1])
    bent = middle > inner - TUBES[kernels.CURVED_LENGTH]
    kappa = np.where(middle < outer, TUBES[kernels.OVERLAP_CURVATURE], TUBES[kernels.INNER_CURVATURE])
    step = inner / 2000
    turn = np.cumsum(kappa * bent) * step - 0.5 * kappa * bent * step
    ways = np.cos(turn)[:, None] * forward + np.sin(turn)[:, None] * normal
    points = base + np.vstack([np.zeros(3), np.cumsum(ways * step, axis=0)])
    return np.stack([np.interp(at, fine, points[:, n]) for n in range(3)], axis=1)


def _drawn_reaching(rng: scenes.Random) -> Reaching:
    """Draw tubes until some are accepted and have a clear arc of the needle ahead."""
    lung = _drawn_lung(rng)
    environment = tube_environment(lung, with_fissures=False)
    needle = environment_of_labels(lung.labels, lung.grid, NEEDLE, required_clearance_mm=REQUIRED_MM)
    while True:
        values, base, reason, _trace, tip = _drawn_tubes(rng, environment)
        if reason != kernels.ACCEPTED:
            continue
        arc = (
            rng.uniform(2.0, 7.0),
            rng.uniform(-3.0, 3.0),
            NEEDLE.max_curvature_per_mm * rng.uniform(0.2, 1.0),
        )
        path = ArcPath(lps_from_start=pose(tip[:3], tip[3:6], tip[6:9]), arcs=np.array([arc]))
        points, lengths = path.sample(0.05)
        beyond = points[lengths >= NEEDLE.exit_exemption_mm]
        free = (
            scenes.true_distances(lung.labels, lung.grid, beyond, OBSTACLES).min(initial=1.0) >= REQUIRED_MM
        )
        at_exit = scenes.true_distances(lung.labels, lung.grid, points, OBSTACLES, 0).min() >= REQUIRED_MM
        out = scenes.true_distances(lung.labels, lung.grid, points, LUMEN).min() >= NEEDLE.radius_mm
        if free and at_exit and out:
            return Reaching(lung=lung, tubes=environment, needle=needle, values=values, base=base, path=path)


def greatest_insertions() -> Float:
    """Return the greatest insertions of the tubes; see the kernel of that name."""
    longest = float(TUBES[kernels.MAX_EXTENSION])
    found = np.zeros(int(longest / kernels.INSERTION_STEP_MM) + 1)
    kernels.greatest_insertions(TUBES, longest, 0.2, found)
    return found


def not_reached(rng: scenes.Random) -> scenes.Case:
    """Draw a deployment that reaches a target; no box that holds it is ruled out, and far ones are."""
    case = _drawn_reaching(rng)
    environment, boxes = _proof_environment(case), []
    for scale in (0.01, 0.03, 0.1, 0.2, 0.3, 0.5):
        halves = scale * HALVES * rng.uniform(0.3, 1.0, 8)
        boxes.append(np.concatenate([case.values + rng.uniform(-1.0, 1.0, 8) * halves, halves]))
    targets = [(case.target, True)] + [(case.target + away * scenes.unit(rng), False) for away in (3.0, 8.0)]
    pieces = unreachable.Pieces(
        frames=FRAME[None],
        first_cone=np.array([0, 1]),
        cones=np.array([[0.0, 0.0, -2.0, 0.0, 0.0, -1.0, 0.8]]),
    )
    count, outcomes = len(boxes), []
    for target, _reached in targets:
        found = unreachable.Found(
            outcome=np.full(count, unreachable.TOO_MANY, dtype=np.uint8), share=np.zeros(count),
            looked=np.zeros(count, dtype=np.int64), left=np.zeros((count, reach_boxes.BOX_COLUMNS)),
        )  # fmt: skip
        unreachable.rule_out(
            environment, TUBES, greatest_insertions(), case.needle.limits, target, pieces, np.array(boxes),
            np.zeros(count, dtype=np.int32), np.arange(count), 20, False, found,
        )  # fmt: skip
        outcomes.append(found)

    def contradiction() -> str:
        wrong = np.flatnonzero(outcomes[0].outcome == unreachable.RULED_OUT)
        return (
            f"{len(wrong)} of {count} boxes ruled out, which hold a deployment that reaches"
            if len(wrong)
            else ""
        )

    return scenes.Case(
        answers=np.concatenate([np.concatenate([o.outcome, o.share, o.looked]) for o in outcomes]),
        contradiction=contradiction,
    )


def _proof_environment(case: Reaching) -> ProofEnvironment:
    """Return what the proof looks at, with tips of the scope wherever there is lumen."""
    lung, spacing = case.lung, case.lung.grid.spacing_mm
    lumen, hazards = (lung.labels & LUMEN) != 0, (lung.labels & (VESSEL | OUTSIDE)) != 0
    to_lumen = distance_corners(lumen, spacing)
    return ProofEnvironment(
        lumen=to_lumen, may_be_left=to_lumen, hazards=distance_corners(hazards, spacing),
        depth=lung.lumen_depth.corners, tips=to_lumen,
        passable=distance_corners((lung.labels & OBSTACLES) == 0, spacing), labels=lung.labels,
        not_lumen=np.asfortranarray(~lumen).view(np.uint8), geometry=lung.geometry,
        depth_geometry=lung.lumen_depth.geometry,
        backward=backward_reach(case.needle, case.target, case.base[:3] - case.target, cell=0.08),
        hazard_bits=VESSEL | OUTSIDE, loss_mm=float(np.linalg.norm(spacing)) + 2.0 / UNITS_PER_MM,
        least_depth_mm=0.2,
    )  # fmt: skip


def cost_bound(rng: scenes.Random) -> scenes.Case:
    """Draw a deployment and a path to a target; no bound of a box that holds it is above the path's cost."""
    case, bounds = _drawn_reaching(rng), []
    cost = path_cost(case)
    tips, limits = case.base[None], case.needle.limits
    environment = bound_environment(case.tubes, limits, WEIGHTS, case.target, tips, 3.0 * cost)
    about = environment, TUBES, greatest_insertions(), tips
    for scale in (0.001, 0.01, 0.03, 0.1, 0.3):
        halves = scale * HALVES[2:5] * rng.uniform(0.3, 1.0, 3)
        boxes = np.zeros((8, deployment_box.BOX_COLUMNS))
        boxes[0, ROTATION : INNER + 1] = case.values[2:5] + rng.uniform(-1.0, 1.0, 3) * halves
        boxes[0, HALF + ROTATION : HALF + INNER + 1] = halves
        boxes[0, [HALF + deployment_box.ACROSS, HALF + deployment_box.UP]] = -1.0
        boxes[0, deployment_box.LOSS + ROTATION] = 1.0
        state = boxes, np.zeros(8, dtype=np.int64), np.arange(8)[::-1].copy(), np.array([1, 7])
        box_queue.divide(*about, tuple(case.target.tolist()), 1, 3.0 * cost, state)
        waiting = state[1][: int(state[3][box_queue.WAITING])]
        bounds.append(boxes[waiting, deployment_box.BOUND].min(initial=3.0 * cost))

    def contradiction() -> str:
        return f"bound {max(bounds):.4f}, cost {cost:.4f}" if max(bounds) > cost * (1.0 + 1e-3) else ""

    return scenes.Case(answers=np.array(bounds), contradiction=contradiction)


def path_cost(case: Reaching) -> float:
    """Return the cost of a path, summed up over true clearances."""
    points, lengths = case.path.sample(0.05)
    middle = 0.5 * (points[1:] + points[:-1])
    clearance = scenes.true_distances(case.lung.labels, case.lung.grid, middle, OBSTACLES)
    rates = WEIGHTS[0] / np.maximum(clearance, CLEARANCE_FLOOR_MM) + WEIGHTS[1]
    return float((rates * np.diff(lengths)).sum())
