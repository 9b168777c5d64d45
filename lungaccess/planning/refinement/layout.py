"""The layout of the refinement's program: the place of each variable, parameter and constraint."""

import itertools
import math
from functools import cache, cached_property
from typing import Any

import numpy as np

from anatomy.base.records import frozen_record, frozen_value
from anatomy.base.typed import Float
from stages.needle import arc_transform
from stages.tube import (
    DesignArrays,
    TubeShape,
    deployed,
    pieces_of_arcs,
    points_on_arcs,
    shape_of_arrays,
    with_any_sweep,
)

AXIS_DEGREE = 5
"""The airway's axis near the site is a polynomial of this degree in the arc length along it."""
AXIS_SCALE_MM = 2.5
"""The scope moves at most so far either way; the polynomial's variable is the arc length in this unit."""
TUBE_POINTS = 24
WALL_CONTACT_MM = 6.0
"""Length of the tubes before the exit where they may touch the wall."""
SLOPE_MM = 0.5
"""Step over which the share of lumen is compared at the exit."""
CURVE_DEGREE = 12
"""Of the polynomial of a shape: it is then right to a hundredth of a millimetre, though curvature jumps where
a tube ends."""
N_FEATURES = 3 * (CURVE_DEGREE + 1) + 10
"""Of a shape: coefficients of its curve, the tip's point, direction and +x, and the space beside it."""


@frozen_value
class Layout:
    """The shape of a program: how many arcs and tubes there are, and how many tubes are turned.

    `zone_points`, `tube_points` and `wall_points` are samples of the needle's exempt length, and of the tubes
    behind and before the exit.
    """

    arcs: int
    with_map: bool
    tubes: int
    turned: int
    weighs_tubes: bool = False
    zone_points: int = 8
    tube_points: int = TUBE_POINTS
    # Samples of the exempt length, the needle, the tubes behind the exit and before it, about one a mm. Slack
    # in the constraints covers what lies between.
    wall_points: int = 8

    @cached_property
    def variables(self) -> dict[str, Any]:
        """Places of the variables: mm, rad, curvatures as shares of the greatest."""
        a = self.arcs
        return {
            **{name: n for n, name in enumerate(("site", "rotation", "outer", "inner", "exit"))},
            "lengths": slice(5, 5 + a),
            "bend_x": slice(5 + a, 5 + 2 * a),
            "bend_y": slice(5 + 2 * a, 5 + 3 * a),
            "middle": slice(5 + 3 * a, 5 + 3 * a + self.middle),
            "turned": slice(5 + 3 * a + self.middle, self.n_variables),
        }

    @property
    def joints(self) -> list[int]:
        """Places of the joints of the tubes; see `ShapeModel`."""
        at = self.variables
        inserted = [at["outer"], *range(at["middle"].start, at["middle"].stop), at["inner"]]
        return [*inserted[-self.tubes :], *range(at["turned"].start, at["turned"].stop)]

    @property
    def middle(self) -> int:
        """Number of middle tubes."""
        return max(self.tubes - 2, 0)

    @property
    def model_terms(self) -> int:
        """Number of terms of the polynomials of the tubes."""
        m = self.tubes + self.turned
        return (m + 1) * (m + 2) // 2

    @property
    def n_variables(self) -> int:
        """Number of variables."""
        return 5 + 3 * self.arcs + self.middle + self.turned

    @property
    def arc_points(self) -> int:
        """Number of samples of each arc: 60 for the needle, fewer of shorter arcs."""
        return max(60 // self.arcs, 1)

    @cached_property
    def parameters(self) -> dict[str, slice]:
        """Places of the parameters, without the values of the fields."""
        sizes = {
            "axis_points": 3 * (AXIS_DEGREE + 1),
            "axis_tangents": 3 * (AXIS_DEGREE + 1),
            "sideways": 3,
            "target": 3,
            "max_curvature_per_mm": 1,
            "outer_radius_step_mm": 1,
            "middle_radius_step_mm": 1,
            "model_centre": self.tubes + self.turned,
            "model": N_FEATURES * self.model_terms,
            "exempt_mm": 1,
            "weigh_clear": 1,
            "weigh_length": 1,
            "weigh_map": 1,
        }
        if self.weighs_tubes:
            sizes |= {"weigh_tubes": 1, "inner_width_mm": 1, "wall_mm": 1}
        for n in range(self.boxes):
            sizes[f"affine{n}"] = 12
            sizes[f"shape{n}"] = 3
        return _in_a_row(sizes)

    @property
    def boxes(self) -> int:
        """Number of fields, see `lungaccess.planning.refinement.boxes`."""
        return 5 if self.with_map else 4

    @property
    def n_parameters(self) -> int:
        """Number of parameters."""
        return _end(self.parameters)

    @cached_property
    def constraints(self) -> dict[str, slice]:
        """Places of the constraints."""
        sizes = {
            "end": 3,
            "curvature": self.arcs,
            "length": 1,
            "turn": 1,
            "cosine": 2 * self.arcs,
            "order": 1,
            "in_tissue": 1,
            "exit": 1,
            "slope": 1,
            "zone": self.zone_points,
            "needle": self.arcs * self.arc_points,
            "tube": self.tube_points + 1,
            "wall": self.wall_points,
            "beside": 1,
            "middle": 2 * self.middle,
        }
        return _in_a_row(sizes)

    @property
    def n_constraints(self) -> int:
        """Number of constraints."""
        return _end(self.constraints)


def _in_a_row(sizes: dict[str, int]) -> dict[str, slice]:
    places, begin = {}, 0
    for name, size in sizes.items():
        places[name] = slice(begin, begin + size)
        begin += size
    return places


def _end(places: dict[str, slice]) -> int:
    return int(max(place.stop for place in places.values()))


@frozen_record
class Numbers:
    """The parameters of one call of a program, and bounds of its variables and of its constraints."""

    parameters: Float
    lower: Float
    upper: Float
    least: Float
    most: Float


INSERTED_MM = 4.0
TURNED_RAD = math.radians(25.0)
"""The program moves joints at most so far: there the polynomials are off by a few hundredths of a
millimetre, which the slack of its constraints covers."""
PLACES = 4 * CURVE_DEGREE
"""Points to which the polynomial of a curve is fitted, so many that it does not swing between them."""


class ShapeModel:
    """The features of a design's shapes near one of them.

    Features are the Chebyshev coefficients of the curve by its share of the length, point, direction and +x
    of the tip, all in the frame of the scope tip, and what has to be free beside the tubes.  No tube is
    inserted farther than `most_mm`; only the one shape is asked for if the model is to be constant.

    Attributes:
        centre, lower, upper ((m,) float64): The joints of the shape and how far they may be moved: all
            insertions, the outermost tube first, in mm, then the rotations of the tubes whose turn changes
            the shape, in rad.
        matrix ((N_FEATURES, 1 + m + m (m + 1) / 2) float64): Of the terms of `terms`.
    """

    def __init__(
        self, design: DesignArrays, shape: TubeShape, most_mm: float, *, constant: bool = False
    ) -> None:
        self._design, self._shape, self._most_mm = design, shape, most_mm
        self.centre = joints_of(design, shape)
        self._steps = np.where(np.arange(len(self.centre)) < len(design.radii), INSERTED_MM, TURNED_RAD)
        self.lower, self.upper = self.centre - self._steps, self.centre + self._steps
        count = len(self.centre)
        self.matrix = np.zeros((N_FEATURES, 1 + count + count * (count + 1) // 2))
        self.matrix[:, 0] = _features(shape)
        if not constant:
            self._fit()

    def shape_at(self, joints: Float) -> TubeShape | None:
        """Return the shape of joints, put in order; None if a limit of the design is not kept."""
        return self._shape_at(self._design, joints)

    def _fit(self) -> None:
        loose = with_any_sweep(self._design)
        unit, count = np.eye(len(self.centre)), len(self.centre)
        moves = [size * unit[m] for m in range(count) for size in (1.0, -1.0, 0.5, -0.5)]
        for one, other in itertools.combinations(range(count), 2):
            moves += [a * unit[one] + b * unit[other] for a in (0.6, -0.6) for b in (0.6, -0.6)]
        rows, values = [], []
        for move in moves:
            made = self._shape_at(loose, self.centre + move * self._steps)
            if made is not None:
                rows.append(terms(joints_of(self._design, made) - self.centre)[1:])
                values.append(_features(made) - self.matrix[:, 0])
        if rows:
            scale = terms(self._steps)[1:]
            fitted = np.linalg.lstsq(np.array(rows) / scale, np.array(values), rcond=1e-9)[0]
            self.matrix[:, 1:] = fitted.T / scale

    def _shape_at(self, design: DesignArrays, joints: Float) -> TubeShape | None:
        n = len(design.radii)
        inserted, turned = np.clip(joints[:n], 0.0, self._most_mm), np.array(self._shape.rotations_rad)
        # A shape nearby is at least so long.
        inserted = np.minimum.accumulate(np.maximum(inserted, 0.5 * (np.arange(n) == n - 1))[::-1])
        turned[design.turned] = joints[n:]
        made = deployed(design, inserted, turned)
        return None if made is None else shape_of_arrays(made)


def terms(moved: Float) -> Float:
    """Return 1, the moves of the joints `(m,)`, and their products in pairs."""
    pairs = itertools.combinations_with_replacement(range(len(moved)), 2)
    return np.array([1.0, *moved, *(moved[a] * moved[b] for a, b in pairs)])


def joints_of(design: DesignArrays, shape: TubeShape) -> Float:
    """Return the joints of a shape as a `ShapeModel` has them."""
    return np.concatenate([shape.insertions_mm[::-1], shape.rotations_rad[design.turned]])


def _features(shape: TubeShape) -> Float:
    length = float(shape.arcs[:, 0].sum())
    shares, inverse = _curve_fit()
    points = points_on_arcs(shape.arcs, np.eye(4), 0.0, length * shares)
    frame = np.eye(4)
    for part, roll, curvature in pieces_of_arcs(shape.arcs, 0.0).tolist():
        frame = frame @ arc_transform(part, roll, curvature)
    frame = frame @ arc_transform(0.0, -float(shape.arcs[-1, 1]), 0.0)
    tip = [frame[:3, 3], frame[:3, 2], frame[:3, 0], [shape.required_beside_mm]]
    return np.concatenate([(inverse @ points).ravel(), *tip])


@cache
def _curve_fit() -> tuple[Float, Float]:
    """Return shares of the length, and what maps points there to Chebyshev coefficients."""
    at = np.cos(math.pi * (np.arange(PLACES) + 0.5) / PLACES)
    inverse = np.linalg.pinv(np.polynomial.chebyshev.chebvander(at, CURVE_DEGREE))
    return 0.5 * (at + 1.0), np.asarray(inverse, dtype=np.float64)
