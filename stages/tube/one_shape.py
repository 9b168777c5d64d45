"""Single deployments of any joint values, proved by the way to them, and tubes and lungs for the kernels."""

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.errors import SettingsError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float, Int
from anatomy.grid import read_only
from anatomy.lung import Lung
from anatomy.margins import Margins
from anatomy.structures import obstacle_bits
from stages.tube import kernels
from stages.tube.arcs import TubeShape
from stages.tube.device import ConcentricTubes, Tube
from stages.tube.equilibrium import SAME_MM, matrices
from stages.tube.following import deploy
from stages.tube.kernels import TubeEnvironment
from stages.tube.kernels import one_shape as kernel
from stages.tube.kernels import shapes as columns
from stages.tube.kernels.one_shape import DesignArrays, ManyShapes, ShapeArrays
from stages.tube.mechanics import TubeMechanics
from stages.tube.sequences import BEND_RAD, together
from stages.tube.shapes import SNAPS, STRAINS, SWEEPS, TubeShapes, strained_radii

DEFAULT_ROTATIONS = 24
"""Rotations 15 degrees apart: at 30 mm of curve, tips are about 3 mm apart, as far as the stops."""
THREADS = 2
"""The kernels run without the interpreter's lock; more threads would wait for memory."""


def tube_environment(lung: Lung, *, with_fissures: bool) -> TubeEnvironment:
    """Return what the tubes collide with in a lung, its fissures too if they are obstacles."""
    field = lung.obstacle_field(with_fissures=with_fissures)
    depth = lung.lumen_depth
    return TubeEnvironment(
        field=field.corners,
        labels=lung.labels,
        geometry=field.geometry,
        bits=obstacle_bits(with_fissures),
        lumen=depth.corners,
        lumen_geometry=depth.geometry,
        mediastinal=lung.tree.mediastinal,
    )


def tube_constants(tubes: ConcentricTubes, margins: Margins) -> Float:
    """Return `(N_TUBES,)` of `stages.tube.kernels.planar`, mm and rad, 0 for curves that are not planar."""
    constants = np.zeros(kernels.N_TUBES)
    inner, outer = tubes.inner, tubes.outermost
    if tubes.planar:
        constants[kernels.OVERLAP_CURVATURE] = tubes.overlap_curvature_per_mm
        constants[kernels.INNER_CURVATURE] = tubes.free_curvature_per_mm
        constants[kernels.CURVED_LENGTH] = inner.curved_length_mm
    constants[kernels.OUTER_RADIUS] = outer.radius_mm
    constants[kernels.INNER_RADIUS] = inner.radius_mm
    constants[kernels.MARGIN] = margins.total_mm
    constants[kernels.MIN_WALL_ANGLE] = math.radians(tubes.min_wall_angle_deg)
    constants[kernels.MAX_SWEEP] = tubes.max_lateral_sweep_mm
    constants[kernels.MAX_EXTENSION] = tubes.max_extension_mm
    constants[kernels.MAX_PROTRUSION] = tubes.max_inner_protrusion_mm
    constants[kernels.MAX_WALL_RUN] = tubes.max_wall_run_mm
    return constants


KEPT = 16
"""Designs in memory: a system, and variants of it that are compared with it."""


@lru_cache(maxsize=KEPT)
def design_arrays(tubes: ConcentricTubes) -> DesignArrays:
    """Return a design and its limits for the kernels."""
    mechanics = TubeMechanics(tubes.nested, needle=tubes.needle_shaft)
    limits = np.zeros(kernel.N_LIMITS)
    # The tubes are looked at every 2 mm of insertion on their way, as in the shapes of two tubes.
    limits[kernel.STEP], limits[kernel.STOP] = mechanics.step_rad, 2.0
    limits[kernel.BEND], limits[kernel.MAX_EXTENSION] = BEND_RAD, tubes.max_extension_mm
    limits[kernel.MAX_SWEEP], limits[kernel.MAX_STRAIN] = tubes.max_lateral_sweep_mm, tubes.max_strain
    bent = np.array([bool(tube.bends) for tube in tubes.nested])
    return DesignArrays(
        *mechanics.design,
        radii=np.array([tube.radius_mm for tube in tubes.nested]),
        strained=strained_radii(tubes.nested, tubes.max_extension_mm),
        turned=bent & (np.cumsum(bent) > 1),
        limits=limits,
        planar=tube_constants(tubes, Margins()) if tubes.planar else np.zeros(0),
    )


def with_any_sweep(design: DesignArrays) -> DesignArrays:
    """Return a design whose tubes may sweep sideways as far as they like."""
    limits = design.limits.copy()
    limits[kernel.MAX_SWEEP] = np.inf
    return design._replace(limits=limits)


def without_limits(design: DesignArrays) -> DesignArrays:
    """Return a design of which any deployment is allowed that is possible and stable."""
    limits = with_any_sweep(design).limits
    limits[kernel.MAX_EXTENSION] = limits[kernel.MAX_STRAIN] = np.inf
    return design._replace(limits=limits)


def shape_arrays(design: DesignArrays) -> ShapeArrays:
    """Return arrays with room for any shape of a design."""
    n = len(design.radii)
    room = columns.MOST_ARCS * (1 + len(design.lengths) + 2 * len(design.bends))
    return ShapeArrays(
        joints=np.zeros(2 * n),
        tips=np.zeros(n),
        result=np.zeros(columns.SHAPE_COLUMNS),
        arcs=np.zeros((room, columns.ARC_COLUMNS)),
        number=np.zeros(1, dtype=np.int64),
    )


def many_shapes(shapes: TubeShapes, members: Int) -> ManyShapes:
    """Return some shapes `(M,)` of a design for the kernels."""
    results = np.zeros((len(members), columns.SHAPE_COLUMNS))
    for column, values in (
        (columns.LEAST, shapes.least_determinant),
        (columns.STRAIN, shapes.strain),
        (columns.SWEEP, shapes.lateral_sweep_mm),
        (columns.LEADER, shapes.follow_the_leader_error_mm),
        (columns.ERROR, shapes.arc_error_mm),
    ):
        results[:, column] = values[members]
    chosen = shapes.subset(members)
    return ManyShapes(
        joints=np.hstack([chosen.insertions_mm, chosen.rotations_rad]),
        tips=np.array(chosen.tip_angles_rad),
        results=results,
        arcs=np.array(chosen.arcs),
        first_arc=np.array(chosen.first_arc),
    )


def copies(shape: ShapeArrays, count: int) -> ManyShapes:
    """Return the same shape so many times."""
    arcs = shape.arcs[: shape.number[0]]
    return ManyShapes(
        joints=np.tile(shape.joints, (count, 1)),
        tips=np.tile(shape.tips, (count, 1)),
        results=np.tile(shape.result, (count, 1)),
        arcs=np.tile(arcs, (count, 1)),
        first_arc=len(arcs) * np.arange(count + 1),
    )


def deployed(design: DesignArrays, insertions_mm: ArrayLike, rotations_rad: ArrayLike) -> ShapeArrays | None:
    """Return the shape of joint values `(n,)`, None if the tubes snap or a limit of the design is broken."""
    shape = shape_arrays(design)
    shape.joints[:] = np.concatenate([np.asarray(insertions_mm), np.asarray(rotations_rad)])
    return shape if kernel.whole_way(design, shape) else None


def shape_or_reason(design: DesignArrays, insertions_mm: Float, rotations_rad: Float) -> TubeShape | str:
    """Return the shape of joint values as `deployed` takes them, or which limit of the design is not kept."""
    shape = shape_arrays(design)
    shape.joints[:] = np.concatenate([insertions_mm, rotations_rad])
    if kernel.whole_way(design, shape):
        return shape_of_arrays(shape)
    inserted, limits, result = insertions_mm, design.limits, shape.result
    if inserted[0] > min(limits[kernel.MAX_EXTENSION], design.lengths[0]):
        return "the tube would extend too far"
    if (-np.diff(inserted) > -np.diff(design.lengths[: len(inserted)]) + SAME_MM).any():
        return "the inner tube is too short to protrude so far"
    if inserted[0] == 0.0:
        return "the tube does not leave the airway"
    if result[columns.LEAST] <= 0.0:
        return SNAPS
    return STRAINS if result[columns.STRAIN] > limits[kernel.MAX_STRAIN] else SWEEPS


def shape_of_arrays(shape: ShapeArrays) -> TubeShape:
    """Return a shape that `deployed` or a search has proved, as a record."""
    n, result = len(shape.tips), shape.result
    return TubeShape(
        insertions_mm=shape.joints[:n].copy(),
        rotations_rad=shape.joints[n:].copy(),
        arcs=shape.arcs[: shape.number[0]].copy(),
        lateral_sweep_mm=float(result[columns.SWEEP]),
        follow_the_leader_error_mm=float(result[columns.LEADER]),
        arc_error_mm=float(result[columns.ERROR]),
        least_determinant=float(result[columns.LEAST]),
    )


ROOM = 4 * columns.MOST_ARCS
"""For arcs: more than designs of three tubes have pieces; it grows where that is too little."""


@frozen_record
class NearbyShape:
    """A deployment with fields as `TubeShapes`; the least determinant is that of the way from nearby."""

    insertions_mm: Float
    rotations_rad: Float
    tip_angles_rad: Float
    arcs: Float
    scope_from_tip: Float
    least_determinant: float
    arc_error_mm: float


class Neighbourhood:
    """One deployment `(n,)` of tubes, from which others nearby are reached straight; see `TubeShapes`."""

    def __init__(
        self, mechanics: TubeMechanics, insertions_mm: Float, rotations_rad: Float, tip_angles_rad: Float
    ) -> None:
        self._mechanics, self._tips, self._turned = mechanics, tip_angles_rad, rotations_rad
        self._radii = np.array([tube.radius_mm for tube in mechanics.tubes])
        self._beta = self._rear_ends(insertions_mm)

    @classmethod
    def of(
        cls,
        tubes: Sequence[Tube],
        insertions_mm: ArrayLike,
        rotations_rad: ArrayLike,
        *,
        needle: Tube | None = None,
    ) -> "Neighbourhood":
        """Return that of a deployment reached by the sequence `together`, a needle's tip at that of tubes.

        Raises SnapError if the tubes snap on the way, and SettingsError if the insertions are impossible.
        """
        mechanics = TubeMechanics(tubes, needle=needle)
        turned = np.array(rotations_rad, dtype=np.float64)
        inserted = np.array(insertions_mm, dtype=np.float64)
        deployed = deploy(mechanics, together(tubes, turned + BEND_RAD, inserted), step_rad=math.pi)
        return cls(mechanics, inserted, turned, np.array(deployed.final.tip_angles_rad))

    def moved(self, shape: NearbyShape) -> "Neighbourhood":
        """Return the neighbourhood of a shape nearby."""
        return Neighbourhood(self._mechanics, shape.insertions_mm, shape.rotations_rad, shape.tip_angles_rad)

    def at(self, insertions_mm: ArrayLike, rotations_rad: ArrayLike) -> NearbyShape | None:
        """Return the shape of joint values `(n,)`, reached straight from that deployment; None if tubes snap.

        Raises SettingsError if numbers are missing or not finite, or the tubes get out of order.
        """
        mechanics, n = self._mechanics, self._mechanics.count
        out, turned = (np.array(values, dtype=np.float64) for values in (insertions_mm, rotations_rad))
        for name, values in (("insertions", out), ("rotations", turned)):
            if values.shape != (n,) or not np.isfinite(values).all():
                raise SettingsError(f"The {name} are {values.tolist()}", expected=f"{n} finite numbers")
        mechanics.check_shifts((out - mechanics.lengths_mm)[None])
        end = self._rear_ends(out)
        result, tips = np.zeros(columns.SHAPE_COLUMNS), self._tips.copy()
        room = ROOM
        while True:
            arcs = np.zeros((room, columns.ARC_COLUMNS))
            count = columns.arcs_near(
                mechanics.design, self._radii, self._turned + BEND_RAD, self._beta, turned - self._turned,
                end, mechanics.step_rad, tips, result, arcs,
            )  # fmt: skip
            if count >= 0:
                break
            room, tips = 2 * room, self._tips.copy()
        if count == 0:
            return None
        return NearbyShape(
            insertions_mm=read_only(out),
            rotations_rad=read_only(turned),
            tip_angles_rad=read_only(tips),
            arcs=read_only(arcs[:count].copy()),
            scope_from_tip=read_only(matrices(result[None, columns.TIP :])[0]),
            least_determinant=float(result[columns.LEAST]),
            arc_error_mm=float(result[columns.ERROR]),
        )

    def _rear_ends(self, insertions_mm: Float) -> Float:
        beta = (insertions_mm - self._mechanics.lengths_mm)[None]
        return np.array(self._mechanics.rear_ends(beta, insertions_mm[:1])[0])
