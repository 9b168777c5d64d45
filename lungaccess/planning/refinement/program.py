"""The nonlinear program of the joint refinement, in CasADi for IPOPT.

All variables move together: the scope's site, rotation and insertions of the tubes, and every arc of the
needle.  The program is built once for a number of arcs; patient, target and candidate are parameters.

Fields are uniform cubic B-splines on boxes of lattice values.  Their value, gradient and second derivatives
at a point are looked up by number (`_look_up`); the program itself sees the quadratic that they define about
the point.  At that point it has the derivatives of the spline, so what CasADi derives from it is exact.

The tubes are polynomials, see `ShapeModel`.  Every piece of the needle is an arc of constant curvature.  Sine
and cosine are power series of the squared angle, so that a straight arc is nothing special and all
derivatives exist there.
"""

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import casadi
import numpy as np

from anatomy.base.typed import Float
from lungaccess.planning.refinement.boxes import (
    BOX_VALUES,
    CLEARANCE,
    LUMEN_SHARE,
    MAP,
    SPARED,
    WALL,
    FieldBox,
)
from lungaccess.planning.refinement.layout import (
    AXIS_DEGREE,
    AXIS_SCALE_MM,
    CURVE_DEGREE,
    N_FEATURES,
    SLOPE_MM,
    WALL_CONTACT_MM,
    Layout,
    Numbers,
)
from stages.needle.kernels import CLEARANCE_FLOOR_MM

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
        shares = [self._thicker_mm(s) for s in places]
        return (
            [self.tube_point(s) for s in [*places, casadi.fmax(self.outer, self.exit)]],
            [*shares, self._thicker_mm(self.exit)],
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


ORDERS = (
    *((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)),
    *((2, 0, 0), (1, 1, 0), (1, 0, 1), (0, 2, 0), (0, 1, 1), (0, 0, 2)),
)
"""Derivatives by the three lattice coordinates that are looked up."""


def _basis(t: Any) -> tuple[tuple[Any, ...], ...]:
    """Return the four cubic B-splines at a fraction of a cell, their slopes and second derivatives."""
    return (
        ((1 - t) ** 3 / 6, (3 * t**3 - 6 * t**2 + 4) / 6, (1 + 3 * t + 3 * t**2 - 3 * t**3) / 6, t**3 / 6),
        (-((1 - t) ** 2) / 2, (3 * t**2 - 4 * t) / 2, (1 + 2 * t - 3 * t**2) / 2, t**2 / 2),
        (1 - t, 3 * t - 2, 1 - 3 * t, t),
    )


def _cell() -> Any:
    """Function: fractions (3,), lattice values (64,) -> (10,) value, gradient, second derivatives."""
    f, c = casadi.SX.sym("fractions", 3), casadi.SX.sym("values", 64)
    bu, bv, bw = (_basis(f[axis]) for axis in range(3))
    along_u = [[sum(bu[d][i] * c[i + 4 * row] for i in range(4)) for row in range(16)] for d in range(3)]
    along_v = {
        (d, e): [sum(bv[e][j] * along_u[d][j + 4 * k] for j in range(4)) for k in range(4)]
        for d in range(3)
        for e in range(3 - d)
    }
    out = [sum(bw[h][k] * along_v[d, e][k] for k in range(4)) for d, e, h in ORDERS]
    return casadi.Function("cell", [f, c], [casadi.vertcat(*out)])


def _look_up(cell: Any, places: Any, shape: Any, numbers: Any, begin: int) -> Any:
    """Return `(13, N)` for lattice coordinates `(3, N)`: these, value, gradient, second derivatives.

    Beyond the box the outermost cell's polynomial goes on.
    """
    count = places.shape[1]
    corner = casadi.fmin(casadi.fmax(casadi.floor(places), 1.0), casadi.repmat(shape, 1, count) - 3.0)
    first = corner[0, :] + shape[0] * (corner[1, :] + shape[1] * corner[2, :])
    grid = [(i, j, k) for k in range(-1, 3) for j in range(-1, 3) for i in range(-1, 3)]
    offsets = casadi.vertcat(*[begin + i + shape[0] * (j + shape[1] * k) for i, j, k in grid])
    index = casadi.repmat(offsets, 1, count) + casadi.repmat(first, 64, 1)
    stencil = casadi.reshape(numbers.get_nz(False, index), 64, count)
    return casadi.vertcat(places, cell.map(count)(places - corner, stencil))


def _floored(clearance: Any) -> Any:
    """Return a clearance in mm that is no less than its floor, rounded there."""
    over = clearance - CLEARANCE_FLOOR_MM
    # Width over which the floor of the clearance is rounded, so that the objective has derivatives.
    return CLEARANCE_FLOOR_MM + 0.5 * (over + casadi.sqrt(over**2 + 0.05**2))


def _quadratic(places: Any, seen: Any) -> list[Any]:
    """Return the field at lattice coordinates by its expansion about the places looked up."""
    out = []
    for n in range(places.shape[1]):
        d = places[:, n] - seen[:3, n]
        v, gu, gv, gw, uu, uv, uw, vv, vw, ww = (seen[3 + m, n] for m in range(10))
        linear = gu * d[0] + gv * d[1] + gw * d[2]
        square = 0.5 * (uu * d[0] ** 2 + vv * d[1] ** 2 + ww * d[2] ** 2)
        out.append(v + linear + square + uv * d[0] * d[1] + uw * d[0] * d[2] + vw * d[1] * d[2])
    return out


class Program:
    """The program for needles of one number of arcs.

    Args:
        iterations: Most steps of IPOPT.
    """

    def __init__(self, layout: Layout, iterations: int) -> None:
        self.layout = layout
        self._build(iterations)
        self._inputs = [np.zeros(self._solver.size1_in(i)) for i in range(self._solver.n_in())]
        self._found, self._cost = np.zeros(layout.n_variables), np.zeros(1)
        self._values = np.zeros(layout.n_constraints)
        self._solve = _bound(self._solver, self._inputs, [self._found])
        self._evaluate = _bound(self._functions["nlp"], self._inputs[:2], [self._cost, self._values])

    def solve(self, start: Float, numbers: Numbers, boxes: tuple[FieldBox, ...]) -> Float:
        """Return the variables `(n,)` at which IPOPT ends, feasible or not."""
        self._fill(start, numbers, boxes)
        self._solve()
        return self._found.copy()

    def evaluate(self, x: Float, numbers: Numbers, boxes: tuple[FieldBox, ...]) -> tuple[float, Float]:
        """Return the objective and the constraints `(m,)` at given variables."""
        self._fill(x, numbers, boxes)
        self._evaluate()
        return float(self._cost[0]), self._values.copy()

    def _fill(self, x: Float, numbers: Numbers, boxes: tuple[FieldBox, ...]) -> None:
        start, parameters, lower, upper, least, most = self._inputs[:6]
        start[:], lower[:], upper[:] = x, numbers.lower, numbers.upper
        least[:], most[:] = numbers.least, numbers.most
        parameters[: self.layout.n_parameters] = numbers.parameters
        for n, box in enumerate(boxes):
            begin = self.layout.n_parameters + sum(BOX_VALUES[:n])
            parameters[begin : begin + len(box.values)] = box.values

    def _build(self, iterations: int) -> None:
        layout = self.layout
        x, p = casadi.SX.sym("x", layout.n_variables), casadi.SX.sym("p", layout.n_parameters)
        geometry = Geometry(layout, x, p)
        needle, steps = geometry.needle_points()
        tubes, thicker = geometry.outside()
        walls, wall_thicker = geometry.before_exit()
        spared = needle[: layout.zone_points] + tubes
        crossing, thick = geometry.in_tissue() if layout.weighs_tubes else ([], [])
        costed = needle + crossing
        looked = [costed, spared, walls, geometry.at_exit()] + ([costed] if layout.with_map else [])
        places = [self._on_lattice(p, n, points) for n, points in enumerate(looked)]
        # Numbers for each look-up: lattice coordinates (3), value, gradient (3), second derivatives (6).
        seen = [casadi.SX.sym(f"seen{n}", 13, len(points)) for n, points in enumerate(looked)]
        fields = [_quadratic(*pair) for pair in zip(places, seen, strict=True)]
        f = self._objective(p, fields, steps)
        if layout.weighs_tubes:
            f += self._objective_of_tubes(p, fields, thick)
        g = self._constraints(p, geometry, fields, thicker + wall_thicker)
        self._solver = self._connect(x, p, f, g, places, seen, iterations)

    def _on_lattice(self, p: Any, box: int, points: list[Any]) -> Any:
        affine = casadi.reshape(p[self.layout.parameters[f"affine{box}"]], 3, 4)
        return affine[:, :3] @ casadi.horzcat(*points) + casadi.repmat(affine[:, 3], 1, len(points))

    def _objective(self, p: Any, fields: list[list[Any]], steps: list[Any]) -> Any:
        clear, length, mapped = (p[self.layout.parameters[f"weigh_{n}"]] for n in ("clear", "length", "map"))
        total: Any = 0.0
        for n, step in enumerate(steps):
            rate = clear / _floored(fields[CLEARANCE][n]) + length
            if self.layout.with_map:
                rate += mapped * fields[MAP][n]
            total += step * rate
        return total

    def _objective_of_tubes(self, p: Any, fields: list[list[Any]], thick: list[Any]) -> Any:
        """Return the part of the tubes in tissue, whose points follow those of the needle."""
        total: Any = 0.0
        for n, step in enumerate(thick, start=-len(thick)):
            rate = 1.0 / _floored(fields[CLEARANCE][n])
            if self.layout.with_map:
                rate += fields[MAP][n]
            total += step * rate
        return p[self.layout.parameters["weigh_tubes"]] * total

    def _constraints(self, p: Any, geometry: Geometry, fields: list[list[Any]], thicker: list[Any]) -> Any:
        zone = self.layout.zone_points
        thicker = [step + geometry.beside for step in thicker]
        ends = [geometry.outer, *casadi.vertsplit(geometry.middle), geometry.inner]
        steps = [after - before for before, after in itertools.pairwise(ends)] if self.layout.middle else []
        tubes = fields[SPARED][zone:] + fields[WALL]
        at_exit, before, behind = fields[LUMEN_SHARE]
        return casadi.vertcat(
            geometry.frames[-1].point - p[self.layout.parameters["target"]],
            *[bx * bx + by * by for bx, by in geometry.bends],
            casadi.sum1(geometry.lengths),
            geometry.turn(),
            *geometry.cosines_from_start(),
            geometry.inner - geometry.outer,
            geometry.inner - geometry.exit,
            at_exit,
            (before - behind) / (2.0 * SLOPE_MM),
            *fields[SPARED][:zone],
            *fields[CLEARANCE][zone : zone + self.layout.arcs * self.layout.arc_points],
            *[c - step for c, step in zip(tubes, thicker, strict=True)],
            geometry.beside,
            *steps,
        )

    def _connect(
        self, x: Any, p: Any, f: Any, g: Any, places: list[Any], seen: list[Any], iterations: int
    ) -> Any:
        """Put look-ups before objective, constraints and their derivatives, and hand all to IPOPT."""
        layout = self.layout
        symbol = casadi.MX.sym("x", layout.n_variables)
        numbers = casadi.MX.sym("p", layout.n_parameters + sum(BOX_VALUES[: len(places)]))
        own = numbers[: layout.n_parameters]
        found, cell, views = casadi.Function("places", [x, p], places)(symbol, own), _cell(), []
        for n in range(len(places)):
            begin = layout.n_parameters + sum(BOX_VALUES[:n])
            views.append(_look_up(cell, found[n], own[layout.parameters[f"shape{n}"]], numbers, begin))
        weights = [casadi.SX.sym("lam_f"), casadi.SX.sym("lam_g", g.shape[0])]
        multipliers = [casadi.MX.sym("lam_f"), casadi.MX.sym("lam_g", g.shape[0])]
        hessian = casadi.hessian(weights[0] * f + casadi.dot(weights[1], g), x)[0]
        self._functions = {}
        for name, outputs, of, given in (
            ("nlp", [f, g], [], []),
            ("grad_f", [f, casadi.gradient(f, x)], [], []),
            ("jac_g", [g, casadi.jacobian(g, x)], [], []),
            ("hess_lag", [casadi.triu(hessian)], weights, multipliers),
        ):
            part = casadi.Function(f"{name}_seen", [x, p, *seen, *of], outputs)
            results = part.call([symbol, own, *views, *given])
            self._functions[name] = casadi.Function(name, [symbol, numbers, *given], results)
        f_of_x, g_of_x = self._functions["nlp"](symbol, numbers)
        problem = {"x": symbol, "p": numbers, "f": f_of_x, "g": g_of_x}
        return casadi.nlpsol("refinement", "ipopt", problem, self._options(iterations))

    def _options(self, iterations: int) -> dict[str, Any]:
        return {
            **{name: self._functions[name] for name in ("grad_f", "jac_g", "hess_lag")},
            "print_time": False,
            "calc_lam_p": False,
            "error_on_fail": False,
            "show_eval_warnings": False,
            "ipopt": {
                "max_iter": iterations,
                "print_level": 0,
                "sb": "yes",
                "tol": 1e-3,
                "constr_viol_tol": 1e-5,
                "acceptable_tol": 1e-2,
                "acceptable_iter": 3,
                "acceptable_obj_change_tol": 1e-3,
                "mu_init": 1e-2,
                "bound_push": 1e-4,
                "bound_frac": 1e-4,
            },
        }


def _bound(function: Any, inputs: list[Float], outputs: list[Float]) -> Callable[[], None]:
    """Return what evaluates a function from and to arrays that stay where they are, without copies."""
    buffer, run = function.buffer()
    for n, array in enumerate(inputs):
        buffer.set_arg(n, memoryview(array.data))
    for n, array in enumerate(outputs):
        buffer.set_res(n, memoryview(array.data))

    def evaluate(_kept: Any = buffer) -> None:
        run()

    return evaluate


@cache
def program(layout: Layout, iterations: int) -> Program:
    """Return the program of a layout, built when first asked for."""
    return Program(layout, iterations)
