"""The nonlinear program of the joint refinement, in CasADi for IPOPT.

All variables move together: the scope's site, rotation and insertions of the tubes, and every arc of the
needle.  The program is built once for a number of arcs; patient, target and candidate are parameters.

Fields are uniform cubic B-splines on boxes of lattice values.  Their value, gradient and second derivatives
at a point are looked up by number (`_look_up`); the program itself sees the quadratic that they define about
the point.  At that point it has the derivatives of the spline, so what CasADi derives from it is exact.
"""

import itertools
from collections.abc import Callable
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
from lungaccess.planning.refinement.geometry import Geometry
from lungaccess.planning.refinement.layout import SLOPE_MM, Layout, Numbers
from stages.needle.kernels import CLEARANCE_FLOOR_MM

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
