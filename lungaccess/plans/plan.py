"""The plan of all three stages: what each device does, why it is allowed, and where it came from."""

import os
from collections.abc import Iterable, Mapping
from dataclasses import field, replace
from functools import cached_property
from itertools import pairwise, takewhile
from typing import TYPE_CHECKING, Self

import numpy as np

from anatomy.base.errors import PlanFileError
from anatomy.base.records import LEFT_OUT_IF_EMPTY, frozen_record
from anatomy.base.typed import Float
from anatomy.base.words import percent, plural
from anatomy.display import AXIAL, CORONAL, Drawing, side_by_side, table
from anatomy.lobes import LEAST_CHANCE
from anatomy.poses import poses_on_pieces
from lungaccess.plans import file as plan_file
from lungaccess.plans.chance import Chance
from lungaccess.plans.curves import (
    STEP_MM,
    DeviceCurve,
    DeviceCurves,
    device_curves,
    needle_pieces,
    pieces_beyond,
    tube_pieces,
)
from lungaccess.plans.parts import Exemption, NeedlePath, Pass, ScopeInsertion, TubeDeployment
from lungaccess.plans.record import Record, shaped
from lungaccess.plans.window import BreathingAim, BreathingWindow
from lungaccess.problem.system import System

if TYPE_CHECKING:
    from anatomy.lung import Lung


@frozen_record
class Plan(Record):
    """One plan: scope motion, tube deployment and needle arcs, with costs, margins and provenance.

    Args:
        patient_name, lung_key: The patient, and the content hash of the lung planned on.
        sources: SHA-256 of every image file.
        system_fingerprint: SHA-256 of the system's settings.
        target_lps: (3,) float64, LPS mm.
        target_origin: Where the target came from; starts with "nodule" if it is the nodule mask.
        objective: What was minimised: a key of `costs`; see `stages.needle.objective.Objective`.
        scope, tube, needle: The stages; `needle` is None where the system has none, and the tip of the tubes
            is at the target.
        required_clearance_mm: Radius plus margins of "outer_tube", "inner_tube" and, where there is one,
            "needle".
        clearance_mm: For "tube" and, where there is one, "needle": smallest distance of the axis from each
            structure ("airway", "vessel", "outside", "fissure"; voxels as solid boxes) where it must be kept.
            A structure may be left out.
        costs: By the keys of `stages.needle.TERMS`: of the needle, or without one of the tubes beyond the
            lumen (costs of the map: beyond the wall); "tissue" of both, where the objective weighs it; and
            the cost under the objective where that is a weighted sum.  A plan of an earlier version may lack
            "voxel_sum".
        kernels: What the planner's machine code was compiled from:
            `lungaccess.plans.version.software_kernels`; "" in a plan that was not planned, or of an earlier
            version.
        needle_planner: The planner of the needle that the search was told to use; "" for the method's own.
        system_choice: Where the system was chosen among several: in sentences, which were tried, why each
            failed, and why this one was chosen; see `lungaccess.judging.answering`.  Empty otherwise.
        timing: Seconds; the only values that differ between two equal runs.
        fissure_chance: Chance that tubes or needle of the worst pass cross a fissure, from its band; None
            where none is known.
        chance: Of success, counted on draws that no search saw: for a plan that was searched by it, and of
            studies that count it; None for any other.
        window: The phases of the breath in which it is proved clear and on target; None where no motion was
            known.
        aim: Where the devices end, of a plan made for its window, or of one whose tool is behind the tip;
            None for any other, which ends at the target.
        cost_bound: Proved lower bound of the cost of every plan from a scope tip of the atlas, where the
            search was told to find one; 0 for any other.
        goals: Values of functions of the plan that it was made good at; see `lungaccess.problem.goals.Goal`.
        further: The passes after the first, from the same place of the scope; see `passes`.
    """

    schema: str = plan_file.SCHEMA
    software_version: str
    patient_name: str
    lung_key: str
    sources: Mapping[str, str]
    breath_hold: str | None
    system: System
    system_fingerprint: str
    target_lps: Float = field(metadata=shaped(3))
    target_origin: str
    fissures_are_obstacles: bool
    objective: str
    scope: ScopeInsertion
    tube: TubeDeployment
    needle: NeedlePath | None
    exemption: Exemption
    required_clearance_mm: Mapping[str, float]
    clearance_mm: Mapping[str, Mapping[str, float]]
    costs: Mapping[str, float]
    method: str
    seed: int
    iterations: int
    timing: Mapping[str, float]
    kernels: str = field(default="", metadata={LEFT_OUT_IF_EMPTY: True})
    needle_planner: str = field(default="", metadata={LEFT_OUT_IF_EMPTY: True})
    system_choice: tuple[str, ...] = field(default=(), metadata={LEFT_OUT_IF_EMPTY: True})
    fissure_chance: float | None = field(default=None, metadata={LEFT_OUT_IF_EMPTY: True})
    chance: Chance | None = field(default=None, metadata={LEFT_OUT_IF_EMPTY: True})
    window: BreathingWindow | None = field(default=None, metadata={LEFT_OUT_IF_EMPTY: True})
    aim: BreathingAim | None = field(default=None, metadata={LEFT_OUT_IF_EMPTY: True})
    cost_bound: float = field(default=0.0, metadata={LEFT_OUT_IF_EMPTY: True})
    goals: Mapping[str, float] = field(default_factory=dict, metadata={LEFT_OUT_IF_EMPTY: True})
    further: tuple[Pass, ...] = field(default=(), metadata={LEFT_OUT_IF_EMPTY: True})

    def _repr_html_(self) -> str:
        """Return the plan as HTML: its figures, and drawings of its devices from the front and the feet."""
        drawings = [self._drawing(view) for view in (CORONAL, AXIAL)]
        figures = table(self.figures(), f"Plan for {self.patient_name}, {self.system.name}")
        return side_by_side(figures, *drawings)

    def _drawing(self, view: str) -> str:
        drawing = Drawing(view)
        for curve in self.shown_curves():
            red, green, blue = (round(255 * c) for c in curve.colour)
            # A thinner device is drawn this wide, so that it can be seen.
            width_mm = max(2.0 * float(curve.radius_mm.max()), 1.5)
            drawing.line(curve.points_lps, f"#{red:02x}{green:02x}{blue:02x}", width_mm)
        drawing.mark(self.tube.exit.point_lps, EXIT_COLOUR)
        drawing.mark(self.target_lps, TARGET_COLOUR)
        return drawing.svg()

    @property
    def end_lps(self) -> Float:
        """Where the devices are to end in the masks' phase, `(3,)` LPS mm: at the target, or at the aim."""
        return self.target_lps if self.aim is None else self.aim.point_lps

    @property
    def goal_lps(self) -> Float:
        """Where the devices have to end so that the tip, or its tool, is at the target, `(3,)` LPS mm."""
        return self.target_lps if self.system.tool is None else self.end_lps

    @cached_property
    def passes(self) -> tuple["Plan", ...]:
        """Each pass as a plan of its own; a plan of one pass is its only one."""
        if not self.further:
            return (self,)
        first = replace(self, further=())
        alone = replace(first, chance=None, window=None, goals={}, cost_bound=0.0)
        return first, *(
            replace(
                alone, tube=each.tube, needle=each.needle, exemption=each.exemption, costs=each.costs,
                clearance_mm=each.clearance_mm,
                aim=BreathingAim(point_lps=each.end_lps, phases=np.zeros((0, 2))),
            )
            for each in self.further
        )  # fmt: skip

    def with_further(self, others: Iterable["Plan"]) -> "Plan":
        """Return the plan with the passes of other plans from the same place of the scope after its own."""
        others = tuple(others)
        made = tuple(
            Pass(
                tube=each.tube, needle=needle, exemption=each.exemption, clearance_mm=each.clearance_mm,
                costs=each.costs, end_lps=each.end_lps,
            )
            for each in others
            if (needle := each.needle) is not None
        )  # fmt: skip
        chances = [one.fissure_chance for one in (self, *others) if one.fissure_chance is not None]
        return replace(self, further=made, fissure_chance=max(chances, default=None))

    @property
    def same_tubes(self) -> tuple[int, ...]:
        """The first pass, counted from 0, with the tubes of each pass."""
        tubes = [(each.tube.rotation_rad, each.tube.lps_from_tip.tobytes()) for each in self.passes]
        return tuple(map(tubes.index, tubes))

    @property
    def redirections(self) -> tuple[str, ...]:
        """What hands do between each pass and the next, in words."""
        said, passes = [], self.passes
        for before, after in pairwise(passes):
            withdrawn, steered = redirection_mm(before, after)
            back = f"withdraw the needle by {withdrawn:.1f} mm"
            if before.tube.lps_from_tip.tobytes() == after.tube.lps_from_tip.tobytes():
                said.append(f"{back}, and steer it {steered:.1f} mm anew from the same tubes")
                continue
            other = "" if before.tube.exit.branch == after.tube.exit.branch else " through another branch"
            said.append(
                f"{back}, draw the tubes into the scope, {after.rotations}, {after.insertions}{other}, and "
                f"steer the needle {steered:.1f} mm"
            )
        return tuple(said)

    @property
    def insertions(self) -> str:
        """How far each tube goes beyond the tip of the scope, in words."""
        inserted = self.tube.insertions_mm(self.system.tubes)
        if len(inserted) == 1:
            return f"tube {inserted[0]:.1f} mm"
        return ", ".join(
            f"{name} tube {length:.1f} mm"
            for (name, _tube), length in zip(self.system.tubes.named, inserted, strict=True)
        )

    @property
    def rotations(self) -> str:
        """How far the tubes are turned about the tip of the scope, in words."""
        turned = [np.degrees(angle) for angle in self.tube.rotations_rad(self.system.tubes)]
        if not any(self.tube.shape.relative_rotations_rad.values()):
            return f"turn to {turned[-1]:.1f}°"
        named = zip(self.system.tubes.named, turned, strict=True)
        return "turn " + ", ".join(
            f"the {name} tube to {angle % 360.0:.1f}°" for (name, tube), angle in named if tube.bends
        )

    @property
    def way_to_target(self) -> str:
        """What goes to the target and how, in words."""
        needle = self.needle
        if needle is None:
            return f"none: the tip of the tubes is at the target, {self.tissue_mm:.1f} mm beyond the lumen"
        return (
            f"{needle.length_mm:.1f} mm in {plural(len(needle.arcs), 'arc')}, at most "
            f"{np.degrees(needle.max_angle_from_start_rad):.1f}° from its start"
        )

    @property
    def fissure_words(self) -> str:
        """The chance of crossing a fissure in words; "" where none is known."""
        chance = self.fissure_chance
        if chance is None:
            return ""
        return "under 3 %" if chance < 0.01 * LEAST_CHANCE else percent(chance, up=True)

    @property
    def tissue_mm(self) -> float:
        """Length of tubes and needle beyond the lumen that the tubes leave."""
        needle_mm = 0.0 if self.needle is None else self.needle.length_mm
        return needle_mm + self.tube.inner_insertion_mm - self.tube.exit.arc_length_mm

    def costed_poses(self, step_mm: float = STEP_MM) -> tuple[Float, Float]:
        """Return poses `(N, 4, 4)` along what the costs are of, and the lengths `(N,)` up to them, mm.

        That is the needle; without one it is the tubes beyond the lumen.
        """
        if self.needle is not None:
            return poses_on_pieces(self.needle.lps_from_start, needle_pieces(self.needle), step_mm)
        pieces = tube_pieces(self.tube)
        start = pieces_beyond(self.scope.lps_from_scope_tip, pieces, self.tube.exit.arc_length_mm)
        return poses_on_pieces(*start, step_mm)

    def figures(self) -> list[tuple[str, str]]:
        """Return what the plan says of devices, distances and costs, as names and values with units."""
        tube = self.tube
        x, y, z = self.target_lps
        rows = [
            ("target, LPS mm", f"{x:.1f}, {y:.1f}, {z:.1f} ({self.target_origin})"),
            (
                "scope",
                f"{self.scope.length_from_carina_mm:.1f} mm beyond the carina, to generation "
                f"{self.scope.generation}",
            ),
            ("tubes", f"{self.rotations}, {self.insertions}"),
            (
                "exit",
                f"branch {tube.exit.branch}, at {np.degrees(tube.exit.wall_angle_rad):.0f}° to the wall",
            ),
            ("needle", self.way_to_target),
        ]
        for device, distances in self.clearance_mm.items():
            words = ", ".join(f"{name} {value:.2f}" for name, value in distances.items())
            least = f"{self.least_required_clearance_mm(device):.2f}"
            rows.append((f"{device}: least distance, mm", f"{words}; needs {least}"))
        if self.fissure_chance is not None:
            rows.append(("chance of crossing a fissure", self.fissure_words))
        costs = ", ".join(f"{name} {value:.4g}" for name, value in self.costs.items() if value)
        return [
            *rows,
            ("costs", f"{costs}; made small: {self.objective}"),
            ("made by", f"{self.method}, seed {self.seed}, {self.iterations} iterations"),
            ("digest", self.digest[:16]),
            *((f"pass {n}", said) for n, said in enumerate(self.redirections, 2)),
            *((("best possible", self.gap_in_words),) if self.gap is not None else ()),
            *((("window of breathing", self.window.words),) if self.window else ()),
            *((("choice of the system", " ".join(self.system_choice)),) if self.system_choice else ()),
        ]

    def least_required_clearance_mm(self, device: str) -> float:
        """Return the clearance that all of "tube" or "needle" keeps: of the tubes, that of the inner one."""
        return self.required_clearance_mm[{"tube": "inner_tube"}.get(device, device)]

    def require_lung(self, lung: "Lung") -> None:
        """Raise PlanFileError unless the plan was made for a lung: the same masks, bit for bit."""
        if self.lung_key != lung.key:
            raise PlanFileError(
                f"The plan was made for {self.patient_name}, whose masks differ from those of {lung.name}",
                expected=f"masks with the key {self.lung_key[:16]}, not {lung.key[:16]}",
                remedy="Name the folder of the patient that was planned on, or plan again on this one",
            )

    def curves(self, step_mm: float = STEP_MM) -> DeviceCurves:
        """Return the three devices as curves; the poses of tubes and needle are at most `step_mm` apart."""
        if step_mm == STEP_MM:
            return self._curves
        return device_curves(self.scope, self.tube, self.needle, self.system, step_mm)

    def shown_curves(self, step_mm: float = STEP_MM) -> tuple[DeviceCurve, ...]:
        """Return the curves of all devices; the names of those that only pass 2 has end in _2."""
        found, seen = list(self.curves(step_mm).present), {*self.same_tubes[:1]}
        for number, (each, tubes) in enumerate(zip(self.passes[1:], self.same_tubes[1:], strict=True), 2):
            curves = each.curves(step_mm)
            own = (curves.needle,) if tubes in seen else (curves.tubes, curves.needle)
            found += [replace(curve, name=f"{curve.name}_{number}") for curve in own]
            seen.add(tubes)
        return tuple(found)

    @cached_property
    def _curves(self) -> DeviceCurves:
        """Return the curves at the usual step, which every picture asks for."""
        return device_curves(self.scope, self.tube, self.needle, self.system)

    @property
    def cost(self) -> float:
        """Cost under the plan's own objective."""
        return float(self.costs[self.objective])

    @property
    def gap(self) -> float | None:
        """Proved share by which the cost exceeds the least from the atlas at most; None without a bound."""
        return max(self.cost / self.cost_bound - 1.0, 0.0) if self.cost_bound > 0.0 else None

    @property
    def gap_in_words(self) -> str:
        """What is proved about the best possible cost, "" without a bound."""
        if self.gap is None:
            return ""
        return (
            f"The cost is proved to be at most {percent(self.gap, up=True)} above the least from any scope "
            f"tip of the atlas, which is {self.cost_bound:.4g} or more."
        )

    @property
    def digest(self) -> str:
        """SHA-256 (hex) of the canonical JSON of everything except `timing`."""
        return plan_file.digest(self)

    def to_json(self) -> str:
        """Return the plan as JSON text, with its digest; PlanFileError if a number is not finite."""
        return plan_file.to_json(self)

    @classmethod
    def from_json(cls, text: str) -> Self:
        """Return the plan that `to_json` wrote; PlanFileError if it is no intact JSON of its schema."""
        return plan_file.from_json(cls, text)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the plan to `path`, all or nothing; FileError if that fails, other errors as `to_json`."""
        plan_file.save(self, path)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Self:
        """Read a plan from `path`; PlanFileError if there is no such file or it is not an intact plan."""
        return plan_file.load(cls, path)


def redirection_mm(before: Plan, after: Plan) -> tuple[float, float]:
    """Return how far the needle is withdrawn between two passes, and how far it is then inserted, mm.

    Arcs that both begin with from the same tubes stay in place, but never the last one.
    """
    if before.needle is None or after.needle is None:
        return 0.0, 0.0
    same = before.tube.lps_from_tip.tobytes() == after.tube.lps_from_tip.tobytes()
    pairs = zip(before.needle.arcs[:-1], after.needle.arcs[:-1], strict=False) if same else ()
    kept = sum(one.length_mm for one, _other in takewhile(lambda both: vars(both[0]) == vars(both[1]), pairs))
    return before.needle.length_mm - kept, after.needle.length_mm - kept


TARGET_COLOUR, EXIT_COLOUR = "#2ca02c", "#d62728"
"""The colours of target and exit in 3D Slicer's scene and in the drawings."""
