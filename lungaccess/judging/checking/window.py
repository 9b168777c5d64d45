"""Last part of the check: in the phases of its window a plan is clear and on target, on deformed meshes.

The surfaces of the voxels near the devices are deformed as the lung is in a phase, and FCL measures from the
carried devices to them.  What holds between the phases that are looked at rests on the planner's proof.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from scipy import ndimage

from anatomy import structures
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from anatomy.meshes import MeshDistance, SurfaceMesh
from lungaccess.judging.checking import shapes
from lungaccess.judging.checking.boxes import Environment, Select, airway_except, has, labels_at, not_lumen
from lungaccess.judging.checking.deployment import OUT_OF_LUMEN_MM, WALL_ZONE_MM, last_wet, rim
from lungaccess.judging.checking.findings import Findings
from lungaccess.judging.checking.outcome import forbidden_bits
from lungaccess.judging.checking.shapes import Curve, cut_at, integrate
from lungaccess.plans.plan import Plan

if TYPE_CHECKING:
    from anatomy.motion.motion import Motion


TIP_BALL_MM = 10.0
"""Tissue so near to the tip of the scope turns it."""
STEPS = 50
"""The fixed point that pulls a point back has so many steps; each leaves a third of the error or less in a
lung."""


class Breath:
    """The breathing of the lung that holds a target, and the devices that the airway around a tip carries."""

    def __init__(self, motion: "Motion", target_lps: Float, tip_lps: Float) -> None:
        side = 1 if target_lps[0] > motion.middle_x_mm else 0
        self._motion, self._nodes = motion, np.moveaxis(np.asarray(motion.nodes[side]), -1, 0)
        self._tip = np.asarray(tip_lps, dtype=np.float64)
        # Distance of the places that are looked at in it.
        steps = np.arange(-TIP_BALL_MM, TIP_BALL_MM + 1e-9, 2.5)
        ball = np.array([(x, y, z) for x in steps for y in steps for z in steps])
        ball = ball[(ball**2).sum(axis=1) <= TIP_BALL_MM**2]
        with_constant = np.column_stack([ball, np.ones(len(ball))])
        fitted = np.linalg.lstsq(with_constant, self.displacement(self._tip + ball), rcond=None)[0]
        self._gradient = fitted[:3].T

    def share(self, phase: float) -> float:
        """Return by which share of its displacement a place of the masks is moved in a phase."""
        return float(self._motion.amplitude * (phase - self._motion.masks_phase))

    def displacement(self, places: Float) -> Float:
        """Return displacements `(N, 3)` from end-exhale to end-inhale of places of the masks `(N, 3)`."""
        grid = self._motion.grid
        index = (places - grid.lps_from_ijk[:3, 3]) / np.diag(grid.lps_from_ijk)[:3]
        parts = [ndimage.map_coordinates(part, index.T, order=1, mode="nearest") for part in self._nodes]
        return np.stack(parts, axis=1)

    def moved(self, places: Float, phase: float) -> Float:
        """Return where places of the masks are."""
        return np.asarray(places + self.share(phase) * self.displacement(places))

    def pulled_back(self, points: Float, phase: float) -> Float:
        """Return which places of the masks are at points."""
        share, found = self.share(phase), np.asarray(points)
        for _ in range(STEPS):
            before, found = found, points - share * self.displacement(found)
            # A step below this ends the search for a place.
            if float(np.abs(found - before).max(initial=0.0)) < 1e-8:
                break
        return found

    def carried(self, points: Float, phase: float) -> Float:
        """Return where points of the devices are: the tip as its tissue, turned as the tissue around it."""
        left, _sizes, right = np.linalg.svd(np.eye(3) + self.share(phase) * self._gradient)
        return np.asarray((points - self._tip) @ (left @ right).T + self.moved(self._tip[None], phase))


MESH_TOLERANCE_MM = 0.005
"""A deformed face is flat here: off by a voxel's edge times what the gradient changes on it."""
NEAR_MM = 0.5
"""Voxels are meshed that come nearer than what is required and this in any phase."""
CORNER_MM = 0.06
"""An axis in the airway cuts corners by 0.05 mm; a sample may see a little more."""
ROUNDING = 1e-9


@frozen_record
class Part:
    """A stretch of the devices `(N, 3)` as planned, what it is to be clear of, and by how much."""

    name: str
    points: Float
    select: Select
    required_mm: float


def check_window(plan: Plan, environment: Environment, found: Findings) -> None:
    """Record whether the stated window holds; a patient without motion has none, and needs none."""
    window, motion = plan.window, environment.lung.motion
    if plan.aim is not None and plan.system.tool is None:
        _check_aim(plan, found)
    if window is None or motion is None:
        if window is not None:
            detail = "the plan states a window, but no motion of the patient is known"
            found.true("window.motion", False, detail)
        elif motion is not None:
            found.unchecked("window", "the plan states no window of breathing")
        return
    found.true("window.motion", window.motion_key == motion.key, "the motion is that of the patient")
    beside = float(np.linalg.norm(np.asarray(plan.end_lps) - np.asarray(plan.goal_lps)))
    found.agrees("window.beside_target", window.beside_target_mm, beside, ROUNDING, "mm")
    names = ("masks_phase", "amplitude", "warning_only", "hysteresis")
    same = (window.motion_source, *(getattr(window, name) for name in names))
    own = (motion.source, *(getattr(motion, name) for name in names))
    detail = f"{window.motion_source}; phase of the masks {window.masks_phase:g}"
    found.true("window.source", same == own, detail)
    detail = "largest distance to the moving target that is promised"
    # The promise of a window is an end within this of the moving target.
    found.at_most("window.tolerance", window.tolerance_mm, 2.0, "mm", detail)
    if window.warning_only:
        found.unchecked("window.model", "the motion is that of other people's lungs: a warning, no promise")
    _check_ends(plan, found)
    breath = Breath(motion, np.asarray(plan.target_lps), np.asarray(plan.scope.lps_from_scope_tip[:3, 3]))
    devices = _Devices(plan, environment)
    _check_target(plan, breath, devices, found)
    _check_clear(plan, environment, breath, devices, found)


class _Devices:
    """Tubes and needle, integrated anew, with the parts that have a rule of their own."""

    def __init__(self, plan: Plan, environment: Environment) -> None:
        self._plan, self._has_fissures = plan, environment.lung.has_fissures
        way_out = plan.tube.exit.arc_length_mm
        pieces = shapes.tube_pieces(plan)
        self.hole_mm = float(shapes.radius_at(plan, np.array([way_out]))[0])
        # A wall that is pierced at less counts as pierced at this angle.
        angle = max(plan.tube.exit.wall_angle_rad, np.deg2rad(10.0))
        self.zone_mm = WALL_ZONE_MM + self.hole_mm / float(np.sin(angle))
        for at in (way_out, way_out + self.zone_mm, *plan.tube.insertions_mm(plan.system.tubes)):
            pieces = cut_at(pieces, at)
        self.tube: Curve = integrate(plan.scope.lps_from_scope_tip, pieces)
        self.needle: Curve | None = None
        if plan.needle is not None:
            cut = cut_at(plan.needle.arcs, plan.exemption.needle_length_mm)
            self.needle = integrate(plan.needle.lps_from_start, cut)

    @property
    def end(self) -> Float:
        """Where the devices end, `(3,)`."""
        return np.asarray((self.needle or self.tube).end[:3, 3])

    def from_tip_mm(self, points: Float) -> Float:
        """Return the distances of points from the tip of the scope."""
        return np.asarray(np.linalg.norm(points - self._plan.scope.lps_from_scope_tip[:3, 3], axis=-1))

    def in_airway(self) -> Curve:
        """Return the tubes up to their exit."""
        keep = self.tube.arc_mm <= self._plan.tube.exit.arc_length_mm + ROUNDING
        return replace(self.tube, frames=self.tube.frames[keep], arc_mm=self.tube.arc_mm[keep])

    def parts(self) -> Iterator[Part]:
        """Yield what the devices beyond the exit must be clear of."""
        plan, bits = self._plan, forbidden_bits(self._plan)
        others, not_own = has(bits & ~structures.AIRWAY), airway_except(plan.exemption.branch)
        extra = plan.system.margins.total_mm + plan.tube.clearance_loss_mm
        way_out, begin = plan.tube.exit.arc_length_mm, plan.tube.exit.arc_length_mm
        for (name, tube), end in zip(
            plan.system.tubes.named, plan.tube.insertions_mm(plan.system.tubes), strict=True
        ):
            points = _between(self.tube, begin, end)
            begin = max(begin, end)
            if len(points) > 1:
                required = 0.5 * tube.outer_diameter_mm + extra
                yield Part(name=f"{name}_tube", points=points, select=others, required_mm=required)
                yield Part(name=f"{name}_tube", points=points, select=not_own, required_mm=required)
        beyond = _between(self.tube, way_out + self.zone_mm, float(self.tube.arc_mm[-1]))
        if len(beyond) > 1:
            lumen = has(structures.LUMEN)
            yield Part(name="beyond_wall", points=beyond, select=lumen, required_mm=OUT_OF_LUMEN_MM)
        yield from self._needle_parts(others, not_own)

    def _needle_parts(self, others: Select, not_own: Select) -> Iterator[Part]:
        needle, device = self.needle, self._plan.system.needle
        if needle is None or device is None:
            return
        radius = 0.5 * device.diameter_mm
        required, exempt = radius + self._plan.system.margins.total_mm, self._plan.exemption.needle_length_mm
        near, far = _between(needle, 0.0, exempt), _between(needle, exempt, float(needle.arc_mm[-1]))
        cases = [
            (needle.points, others, required), (near, not_own, required),
            (near, has(structures.LUMEN), radius), (far, has(structures.AIRWAY), required),
        ]  # fmt: skip
        for points, select, least in cases:
            if len(points) > 1:
                yield Part(name="needle", points=points, select=select, required_mm=least)


def _between(curve: Curve, begin: float, end: float) -> Float:
    return curve.points[(curve.arc_mm >= begin - ROUNDING) & (curve.arc_mm <= end + ROUNDING)]


def _check_aim(plan: Plan, found: Findings) -> None:
    """Devices may end beside the target only if a window holds, without a gap, what was asked for."""
    held = np.zeros((0, 2)) if plan.window is None else plan.window.phases
    asked = np.zeros((0, 2)) if plan.aim is None else plan.aim.phases
    found.true("window.of_aim", len(held) > 0, "a plan that ends at an aim has a window")
    for begin, end in asked:
        whole = bool(((held[:, 0] <= begin) & (held[:, 1] >= end)).any())
        found.true("window.asked", whole, f"the window holds the phases {begin:g} to {end:g}")


def _check_ends(plan: Plan, found: Findings) -> None:
    """Every end of the window within the breath has a limit, in order; without a window one says why."""
    window = plan.window
    if window is None:
        return
    ends = [float(each) for each in window.phases.ravel() if 0.0 < each < 1.0]
    stated = [each.phase for each in window.limits]
    known = stated == ends if len(window.phases) else len(stated) == 1
    found.true("window.limits", known, f"{len(stated)} limits of {len(ends)} ends within the breath")
    detail = "share of the breath that is not decided"
    found.at_most("window.undecided", window.undecided_share, 1.0 - window.share, "", detail, ROUNDING)


def _check_target(plan: Plan, breath: Breath, devices: _Devices, found: Findings) -> None:
    window = plan.window
    if window is None or not len(window.phases):
        return
    # Phases at which the distance to the target is looked at, which costs nothing.
    phases = np.concatenate([np.linspace(a, b, 200) for a, b in window.phases])
    end, goal = devices.end[None], np.asarray(plan.goal_lps)[None]
    misses = (breath.carried(end, float(phase)) - breath.moved(goal, float(phase)) for phase in phases)
    most = max(float(np.linalg.norm(miss)) for miss in misses)
    detail = f"end of the devices to the moving target, at {len(phases)} phases of the window"
    most += window.hysteresis * (float(devices.from_tip_mm(devices.end)) + most)
    found.at_most("window.target", most, window.tolerance_mm, "mm", detail, ROUNDING)
    hole = np.asarray(plan.tube.exit.point_lps)[None]
    shifts = [breath.carried(hole, float(phase)) - breath.moved(hole, float(phase)) for phase in phases]
    most = float(np.linalg.norm(np.concatenate(shifts), axis=1).max())
    detail = "shift of the tubes in the hole in the airway wall; at most their radius"
    most += window.hysteresis * (float(devices.from_tip_mm(hole[0])) + most)
    # The point of the exit is known to this.
    found.at_most("window.hole", most, devices.hole_mm, "mm", detail, 0.02)


def _check_clear(
    plan: Plan, environment: Environment, breath: Breath, devices: _Devices, found: Findings
) -> None:
    """At phases of the window every part keeps its distance; the tubes stay in the airway up to the exit."""
    window = plan.window
    if window is None or not len(window.phases):
        return
    # Between two phases that are looked at a device moves against tissue by less than a millimetre, mostly.
    phases = [
        float(phase)
        for a, b in window.phases
        for phase in np.linspace(a, b, max(int(np.ceil((b - a) / 0.05)), 1) + 1)
    ]
    spare, worst, inside, airway = np.inf, "", 0, 0
    for part in devices.parts():
        kept = _kept_mm(part.required_mm, window.hysteresis, devices.from_tip_mm(part.points))
        mesh = _surface(part, environment, breath, phases, float(np.max(kept)))
        for phase in phases:
            points = breath.carried(part.points, phase)
            inside += int(part.select(labels_at(environment.lung, breath.pulled_back(points, phase))).sum())
            left = _least_spare(_deformed(mesh, breath, phase), points, kept)
            if left < spare:
                spare, worst = left, f"{part.name} at phase {phase:.3f}"
    for phase in phases:
        airway += _out_of_airway(plan, environment, breath, devices, phase)
    found.true("window.containment", inside == 0, f"{inside} samples in an obstacle, at {len(phases)} phases")
    detail = f"least to spare beside radius and margins, at {len(phases)} phases: {worst}"
    found.at_least("window.clearance", spare, 0.0, "mm", detail, MESH_TOLERANCE_MM)
    found.true(
        "window.in_airway", airway == 0, f"{airway} samples of the tubes before their exit break the rule"
    )


def _deformed(mesh: SurfaceMesh, breath: Breath, phase: float) -> MeshDistance:
    """Return a surface of the masks as it is in a phase."""
    if not len(mesh.faces):
        return MeshDistance(mesh)
    return MeshDistance(replace(mesh, vertices_lps=breath.moved(mesh.vertices_lps, phase)))


def _surface(
    part: Part, environment: Environment, breath: Breath, phases: list[float], required: float
) -> SurfaceMesh:
    """Return the surface of the voxels that come near a part in any of the phases, as in the masks."""
    spread = [min(phases), max(phases), 0.5 * (min(phases) + max(phases))]
    places = [breath.pulled_back(breath.carried(part.points, phase), phase) for phase in spread]
    slack = max(float(np.linalg.norm(each - places[2], axis=1).max()) for each in places[:2])
    boxes = environment.boxes(part.select, required)
    return boxes.surface_near(np.concatenate(places), 1.5 * (required + NEAR_MM) + 0.3 * slack)


def _out_of_airway(
    plan: Plan, environment: Environment, breath: Breath, devices: _Devices, phase: float
) -> int:
    """Return how many samples before the exit leave the lumen, or touch its wall with something behind it."""
    curve, share = devices.in_airway(), plan.window.hysteresis if plan.window else 0.0
    points = breath.carried(curve.points, phase)
    strays = _kept_mm(np.zeros(len(points)), share, devices.from_tip_mm(curve.points))
    before = curve.arc_mm <= plan.tube.exit.arc_length_mm - devices.zone_mm
    places = breath.pulled_back(points, phase)[before]
    out = environment.boxes(has(structures.LUMEN), 1.0).distance_mm(places)
    broken = int((out > CORNER_MM).sum()) + _touching(plan, environment, breath, curve, phase, strays)
    if share and len(places):
        most = float(strays.max())
        wall = environment.boxes(not_lumen, most).surface_near(places, 1.5 * (most + NEAR_MM))
        depth = _gaps(_deformed(wall, breath, phase), points[before])
        broken += int((depth < strays[before] - CORNER_MM).sum())
    return broken


def _kept_mm(required: Float | float, share: float, lever_mm: Float) -> Float:
    """Return the clearances by the motion `(N,)` that leave what is required wherever tissue strays.

    What is c mm from a point is at most `lever + c` from the tip of the scope, and strays by a share of this.
    """
    return np.asarray((required + share * lever_mm) / (1.0 - share))


def _least_spare(mesh: MeshDistance, points: Float, kept: Float) -> float:
    """Return the least of distance less `kept` `(N,)` along points, by pieces over which it hardly varies."""
    # What is to be kept from straying tissue is taken as equal along pieces over which it varies by this.
    pieces = 1 + int(np.ptp(kept) / 0.01)
    ends = np.linspace(0, len(points) - 1, pieces + 1).astype(int)
    return min(
        mesh.polyline_distance_mm(points[a : b + 1]) - float(kept[a : b + 1].min())
        for a, b in zip(ends[:-1], ends[1:], strict=True)
    )


def _gaps(mesh: MeshDistance, points: Float) -> Float:
    return np.array([mesh.polyline_distance_mm(point[None]) for point in points])


def _touching(
    plan: Plan, environment: Environment, breath: Breath, curve: Curve, phase: float, strays: Float
) -> int:
    """Return how many samples from the last contact with the wall on have an obstacle behind it too near."""
    radius = shapes.radius_at(plan, curve.arc_mm)
    around = breath.carried(rim(curve.frames, radius + strays), phase)
    first = last_wet(labels_at(environment.lung, breath.pulled_back(around, phase)))
    points = breath.carried(curve.points[first:], phase)
    needed = radius[first:] + plan.system.margins.total_mm + plan.tube.clearance_loss_mm + strays[first:]
    boxes = environment.boxes(has(forbidden_bits(plan) & ~structures.AIRWAY), float(needed.max()))
    mesh = boxes.surface_near(breath.pulled_back(points, phase), 1.5 * (float(needed.max()) + NEAR_MM))
    return int((_gaps(_deformed(mesh, breath, phase), points) < needed - MESH_TOLERANCE_MM).sum())
