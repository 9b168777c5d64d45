"""The curve of tubes and needle as symbols.

The tubes are polynomials, see `ShapeModel`.  Every piece of the needle is an arc of constant curvature.  Sine
and cosine are power series of the squared angle, so that a straight arc is nothing special and all
derivatives exist there.
"""

from dataclasses import dataclass
from typing import Any

import casadi

from lungaccess.planning.refinement.layout import (
    AXIS_DEGREE,
    AXIS_SCALE_MM,
    CURVE_DEGREE,
    N_FEATURES,
    SLOPE_MM,
    WALL_CONTACT_MM,
    Layout,
)

SERIES_TERMS = 14
"""Up to an angle of 2 pi the series are off by less than 1e-6."""


def _series(q: Any, first: int) -> Any:
    """Return sin(a) / a (`first` = 1) or (1 - cos(a)) / a^2 (`first` = 2) of q = a^2, smooth at 0."""
    total: Any = 0.0
    for k in reversed(range(SERIES_TERMS)):
        total = 1.0 - q / ((2 * k + first + 1) * (2 * k + first + 2)) * total if k < SERIES_TERMS - 1 else 1.0
    return total if first == 1 else 0.5 * total


def _before(end: Any, s: Any) -> Any:
    """Return 1 before the end of a tube and 0 behind it."""
    # Length over which the radius changes at the end of the outer tube, so that it has derivatives.
    return 0.5 + 0.5 * casadi.tanh((end - s) / 0.2)


@dataclass(frozen=True)
class Frame:
    """A symbolic pose: three columns and a point, each (3,)."""

    x: Any
    y: Any
    z: Any
    point: Any

    def point_at(self, kx: Any, ky: Any, s: Any) -> Any:
        """Return the point at arc length `s` of an arc with curvatures towards x and y."""
        q = (kx * kx + ky * ky) * s * s
        return self.point + s * _series(q, 1) * self.z + s * s * _series(q, 2) * (kx * self.x + ky * self.y)

    def tangent_at(self, kx: Any, ky: Any, s: Any) -> Any:
        """Return the tangent there."""
        q = (kx * kx + ky * ky) * s * s
        return (1.0 - q * _series(q, 2)) * self.z + s * _series(q, 1) * (kx * self.x + ky * self.y)

    def along(self, kx: Any, ky: Any, s: Any) -> "Frame":
        """Return the frame at the end of an arc, transported without roll."""
        q = (kx * kx + ky * ky) * s * s
        sine, versine = s * _series(q, 1), s * s * _series(q, 2)
        bend = kx * self.x + ky * self.y
        return Frame(
            x=self.x - kx * (sine * self.z + versine * bend),
            y=self.y - ky * (sine * self.z + versine * bend),
            z=self.tangent_at(kx, ky, s),
            point=self.point_at(kx, ky, s),
        )


class Geometry:
    """The curve of tubes and needle as expressions of variables `x` and parameters `p`."""

    def __init__(self, layout: Layout, x: Any, p: Any) -> None:
        self._layout, self._p = layout, p
        at = layout.variables
        names = ("site", "rotation", "outer", "inner", "exit")
        self.site, self.rotation, self.outer, self.inner, self.exit = (x[at[n]] for n in names)
        self.lengths = x[at["lengths"]]
        kappa = self._value("max_curvature_per_mm")
        self.bends = [(x[at["bend_x"]][a], x[at["bend_y"]][a]) for a in range(layout.arcs)]
        self._kappa = kappa
        self.features: Any = self._features(x)
        self.middle = x[at["middle"]]
        self.tip = self._tip()
        self.frames = [self.tip]
        for a, (bx, by) in enumerate(self.bends):
            self.frames.append(self.frames[-1].along(kappa * bx, kappa * by, self.lengths[a]))

    def _value(self, name: str) -> Any:
        return self._p[self._layout.parameters[name]]

    def scope_tip(self) -> Frame:
        """Return the tip of the scope, turned so that the tubes bend towards its x."""
        powers = casadi.vertcat(*[(self.site / AXIS_SCALE_MM) ** k for k in range(AXIS_DEGREE + 1)])
        names = ("axis_points", "axis_tangents")
        rows = [casadi.reshape(self._value(n), AXIS_DEGREE + 1, 3).T @ powers for n in names]
        z = rows[1] / casadi.norm_2(rows[1])
        side = self._value("sideways")
        x = side - casadi.dot(side, z) * z
        x = x / casadi.norm_2(x)
        y = casadi.cross(z, x)
        c, s = casadi.cos(self.rotation), casadi.sin(self.rotation)
        return Frame(x=c * x + s * y, y=c * y - s * x, z=z, point=rows[0])

    def _features(self, x: Any) -> Any:
        moved = x[self._layout.joints] - self._value("model_centre")
        pairs = [moved[a] * moved[b] for a in range(moved.shape[0]) for b in range(a, moved.shape[0])]
        matrix = casadi.reshape(self._value("model"), self._layout.model_terms, N_FEATURES).T
        return matrix @ casadi.vertcat(1.0, moved, *pairs)

    @property
    def beside(self) -> Any:
        """What has to be free beside the tubes, mm."""
        return self.features[-1]

    def _tip(self) -> Frame:
        scope, rows = self.scope_tip(), self.features[-10:-1]
        point, z, x = (
            rows[3 * m] * scope.x + rows[3 * m + 1] * scope.y + rows[3 * m + 2] * scope.z for m in range(3)
        )
        z = z / casadi.norm_2(z)
        x = x - casadi.dot(x, z) * z
        x = x / casadi.norm_2(x)
        return Frame(x=x, y=casadi.cross(z, x), z=z, point=scope.point + point)

    def tube_point(self, s: Any) -> Any:
        """Return the point of the tubes at arc length `s` by Clenshaw's sum of the Chebyshev polynomials."""
        scope, at = self.scope_tip(), 2.0 * s / self.inner - 1.0
        rows: Any = casadi.reshape(self.features[: 3 * (CURVE_DEGREE + 1)], 3, CURVE_DEGREE + 1)
        one: Any = 0.0
        two: Any = 0.0
        for k in range(CURVE_DEGREE, 0, -1):
            one, two = rows[:, k] + 2.0 * at * one - two, one
        local = rows[:, 0] + at * one - two
        return scope.point + local[0] * scope.x + local[1] * scope.y + local[2] * scope.z

    def outside(self) -> tuple[list[Any], list[Any]]:
        """Return points of the tubes from the exit to the tip, and by how much they are thicker there.

        The last one is the end of the outer tube.
        """
        count = self._layout.tube_points
        places = [self.exit + (self.inner - self.exit) * m / (count - 1) for m in range(count)]
        return (
            [self.tube_point(s) for s in [*places, casadi.fmax(self.outer, self.exit)]],
            [*[self._thicker_mm(s) for s in places], self._thicker_mm(self.exit)],
        )

    def in_tissue(self) -> tuple[list[Any], list[Any]]:
        """Return points of the tubes amid equal steps from the wall to the tip, and width times step."""
        count, begin = self._layout.tube_points, self.exit + self._value("wall_mm")
        step = casadi.fmax(self.inner - begin, 0.0) / count
        places = [begin + (m + 0.5) * step for m in range(count)]
        widths = [self._value("inner_width_mm") + 2.0 * self._thicker_mm(s) for s in places]
        return [self.tube_point(s) for s in places], [step * width for width in widths]

    def before_exit(self) -> tuple[list[Any], list[Any]]:
        """Return the same for the last WALL_CONTACT_MM before the exit."""
        count = self._layout.wall_points
        places = [casadi.fmax(self.exit - WALL_CONTACT_MM * m / count, 0.0) for m in range(1, count + 1)]
        return [self.tube_point(s) for s in places], [self._thicker_mm(s) for s in places]

    def at_exit(self) -> list[Any]:
        """Return the exit, and the points a little before and behind it."""
        return [self.tube_point(self.exit + shift) for shift in (0.0, -SLOPE_MM, SLOPE_MM)]

    def _thicker_mm(self, s: Any) -> Any:
        thicker = self._value("outer_radius_step_mm") * _before(self.outer, s)
        for m in range(self._layout.middle):
            thicker += self._value("middle_radius_step_mm") * _before(self.middle[m], s)
        return thicker

    def needle_points(self) -> tuple[list[Any], list[Any]]:
        """Return points amid equal steps of the exempt length, then of every arc, and the steps' lengths."""
        points, steps = [], []
        zone = self._value("exempt_mm")
        for a in range(self._layout.arcs):
            begin, (kx, ky) = zone if a == 0 else 0.0, (self._kappa * bend for bend in self.bends[a])
            pieces = [(0.0, zone, self._layout.zone_points)] if a == 0 else []
            pieces.append((begin, self.lengths[a], self._layout.arc_points))
            for low, high, count in pieces:
                step = (high - low) / count
                for m in range(count):
                    points.append(self.frames[a].point_at(kx, ky, low + (m + 0.5) * step))
                    steps.append(step)
        return points, steps

    def turn(self) -> Any:
        """Return the accumulated turn in rad, a little overstated."""
        total: Any = 0.0
        for a, (bx, by) in enumerate(self.bends):
            # Rounds off the turn of an arc at no curvature, as a share of the greatest; it is never
            # understated.
            total += self._kappa * casadi.sqrt(bx * bx + by * by + 1e-3**2) * self.lengths[a]
        return total

    def cosines_from_start(self) -> list[Any]:
        """Return the cosine of the angle to the start, amid and at the end of each arc."""
        out = []
        for a, (bx, by) in enumerate(self.bends):
            for share in (0.5, 1.0):
                length = share * self.lengths[a]
                tangent = self.frames[a].tangent_at(self._kappa * bx, self._kappa * by, length)
                out.append(casadi.dot(self.tip.z, tangent))
        return out
