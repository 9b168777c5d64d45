"""Speed and accuracy of the mechanics of concentric tubes.

    python -m experiments.tube_speed [--quick] [--seed 1] [--results FOLDER]

Equilibria a second of one to three precurved tubes that never snap, with base angles given, stability and tip
frame, in one call and one by one, beside the CasADi model of the same physics; the same for designs drawn at
random, some of which are near snapping; error and time by step; errors against closed forms and, where
LUNGACCESS_DATA is set, against tips that a public C++ code computed.
"""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from benchmarks.scenes import configurations, mechanics, random_mechanics
from experiments.support.anatomies import data_folder, require_data
from experiments.support.machine import median_cpu_s
from experiments.support.results import Result, setting_of, study_parser, write_result
from lungaccess.showing.report import style
from stages.tube.casadi_model import CasadiTubes
from stages.tube.device import Tube
from stages.tube.equilibrium import STEP_RAD
from stages.tube.mechanics import TubeMechanics

COUNTS = (1, 2, 3)
COLOURS = (style.AIRWAY, style.TUBE, style.SCOPE)
STEPS_RAD = (0.3, 0.15, STEP_RAD, STEP_RAD / 2.0, STEP_RAD / 4.0)
FINEST_RAD = STEP_RAD / 16.0
FINE_CASADI_STEPS = 40
PUBLIC_CODES = "the fastest public codes known to us: 5,000 to 29,000, on other machines"
LENGTH_MM = 40.0
REPEATS = 5
RANDOM_DESIGNS = 40


def add_speed(result: Result, many: int, few: int) -> dict[str, list[float]]:
    """Add equilibria a second, and how far the CasADi model's tips are from ours."""
    speeds: dict[str, list[float]] = {"one call": [], "one by one": [], "CasADi": []}
    for count in COUNTS:
        made = mechanics(count)
        angles, beta = configurations(made, many, result.seeds[0])
        batch_s = median_cpu_s(lambda: made.batch(angles, beta), REPEATS) / many  # noqa: B023
        single_s = _each_s(made.given_base_angles, angles[:few], beta[:few])
        oracle = CasadiTubes(made.tubes)
        casadi_s = _each_s(oracle.solve, angles[:few], beta[:few])
        for name, seconds in zip(speeds, (batch_s, single_s, casadi_s), strict=True):
            speeds[name].append(1.0 / seconds)
        _add_speed(result, count, {name: of_count[-1] for name, of_count in speeds.items()}, made, few)
    return speeds


def _each_s(solve: Any, angles: np.ndarray, beta: np.ndarray) -> float:
    """Return the CPU time of one of several calls."""

    def work() -> None:
        for each, rear in zip(angles, beta, strict=True):
            solve(each, rear)

    return median_cpu_s(work, REPEATS) / len(angles)


def _add_speed(result: Result, count: int, speed: dict[str, float], made: TubeMechanics, few: int) -> None:
    tubes = f"{count} tube{'s' if count > 1 else ''}"
    result.add(f"{tubes}: equilibria a second, one call", speed["one call"], note=PUBLIC_CODES)
    result.add(f"{tubes}: equilibria a second, one by one", speed["one by one"])
    result.add(
        f"{tubes}: equilibria a second, CasADi model", speed["CasADi"],
        note=f"ours in one call: {speed['one call'] / speed['CasADi']:.0f} times as many",
    )  # fmt: skip
    angles, beta = configurations(made, few, result.seeds[0])
    tips = made.batch(angles, beta)
    fine = CasadiTubes(made.tubes, steps_per_piece=FINE_CASADI_STEPS)
    apart = [
        _apart_mm(fine.given_tip_angles(tip, rear).base_from_tip, frame)
        for tip, rear, frame in zip(tips.tip_angles_rad, beta, tips.base_from_tip, strict=True)
    ]
    result.add(
        f"{tubes}: tip against the CasADi model, largest", max(apart), unit="mm",
        note=f"{few} equilibria, {FINE_CASADI_STEPS} steps between landmarks",
    )  # fmt: skip


def add_random_designs(result: Result, many: int) -> None:
    """Add equilibria a second of designs drawn at random, in one call a design."""
    each = many // RANDOM_DESIGNS
    for count in COUNTS[1:]:
        designs = random_mechanics(count, RANDOM_DESIGNS)
        drawn = [configurations(made, each, result.seeds[0] + n) for n, made in enumerate(designs)]

        def work(designs: Any = designs, drawn: Any = drawn) -> None:
            for made, joints in zip(designs, drawn, strict=True):
                made.batch(*joints)

        work()
        speeds = []
        for made, joints in zip(designs, drawn, strict=True):
            seconds = median_cpu_s(lambda: made.batch(*joints), REPEATS)  # noqa: B023
            speeds.append(each / seconds)
        result.add(
            f"{count} random tubes: equilibria a second, one call",
            RANDOM_DESIGNS * each / median_cpu_s(work, REPEATS),
            note=f"{RANDOM_DESIGNS} designs; slowest {min(speeds):.0f}, fastest {max(speeds):.0f}",
        )


def _apart_mm(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.linalg.norm(a[:3, 3] - b[:3, 3]))


def add_steps(result: Result, many: int) -> dict[int, tuple[list[float], list[float]]]:
    """Add error of the tip and time of an equilibrium by step; return both by number of tubes."""
    found = {}
    for count in COUNTS[1:]:
        tubes = mechanics(count).tubes
        angles, beta = configurations(mechanics(count), many, result.seeds[0])
        finest = TubeMechanics(tubes, step_rad=FINEST_RAD).batch(angles, beta)
        errors, times = [], []
        for step in STEPS_RAD:
            made = TubeMechanics(tubes, step_rad=step)
            frames = made.batch(angles, beta).base_from_tip
            errors.append(max(_apart_mm(a, b) for a, b in zip(frames, finest.base_from_tip, strict=True)))
            times.append(1e6 * median_cpu_s(lambda: made.batch(angles, beta), REPEATS) / many)  # noqa: B023
            default = " (default)" if step == STEP_RAD else ""
            result.add(
                f"{count} tubes, step {step:.3g} rad{default}: largest error of the tip", errors[-1],
                unit="mm", note=f"{times[-1]:.1f} us an equilibrium; against a step of {FINEST_RAD:.2g} rad",
            )  # fmt: skip
        found[count] = (errors, times)
    return found


def add_reference(result: Result) -> None:
    """Add errors against closed forms and stored tips, where LUNGACCESS_DATA is set."""
    stored = json.loads(require_data("ctr/vectors_dev.json").read_text(encoding="utf-8"))
    rows = stored["two_tube_pendulum"]["rows"]
    worst = max(abs(_pendulum_base_rad(row) - float(row["theta_0"])) for row in rows)
    note = f"{len(rows)} rows"
    result.add("two tubes, closed form of the base angle: largest error", worst, unit="rad", note=note)
    tip_mm, base_rad, determinant = 0.0, 0.0, 0.0
    rows = stored["vanderbilt_cannula_kinematics"]["rows"]
    for row in rows:
        made = TubeMechanics([_tube(each) for each in row["tubes"]], least_clearance_mm=None)
        there = made.given_tip_angles(row["psi_L"], 1e3 * np.array(row["beta"]))
        known = row["vanderbilt"]
        off = there.base_from_tip[:3, 3] - 1e3 * np.array(known["p_tip"])
        tip_mm = max(tip_mm, float(np.linalg.norm(off)))
        base_rad = max(base_rad, float(np.abs(there.base_angles_rad - known["alpha"]).max()))
        found = float(there.determinant([there.beta_mm.min()])[0])
        determinant = max(determinant, abs(found / known["det"] - 1.0))
    note = f"{len(rows)} configurations of two and three tubes, tip angles given"
    result.add("public C++ code: tip, largest difference", tip_mm, unit="mm", note=note)
    result.add("public C++ code: base angles, largest difference", base_rad, unit="rad", note=note)
    result.add("public C++ code: determinant, largest relative difference", determinant, note=note)


def _pendulum_base_rad(row: dict[str, Any]) -> float:
    """Return the angle between the rear ends of two equal tubes that are curved from end to end."""
    tube = Tube(outer_diameter_mm=1.5, inner_diameter_mm=1.3, length_mm=LENGTH_MM)
    curvature = row["lam"] / (LENGTH_MM * math.sqrt(1.0 + tube.poisson_ratio))
    bent = Tube(
        outer_diameter_mm=1.5, inner_diameter_mm=1.3, length_mm=LENGTH_MM, curved_length_mm=LENGTH_MM,
        precurvature_per_mm=curvature,
    )  # fmt: skip
    made = TubeMechanics([bent, bent], least_clearance_mm=None)
    base = made.given_tip_angles([0.0, row["theta_L"]], [0.0, 0.0]).base_angles_rad
    return float(base[1] - base[0])


def _tube(stored: dict[str, float]) -> Tube:
    return Tube(
        outer_diameter_mm=1e3 * stored["OD"], inner_diameter_mm=1e3 * stored["ID"],
        length_mm=1e3 * stored["L"], curved_length_mm=1e3 * (stored["L"] - stored["Lt_straight"]),
        precurvature_per_mm=1e-3 * stored["kappa"], youngs_modulus_gpa=1e-9 * stored["E"],
        poisson_ratio=0.5 * stored["E"] / stored["G"] - 1.0,
    )  # fmt: skip


def draw(speeds: dict[str, list[float]], steps: dict[int, tuple[list[float], list[float]]]) -> Figure:
    """Draw equilibria a second by number of tubes, and error of the tip over time by step."""
    figure = style.new_figure(10.0, 4.0)
    left, right = figure.subplots(1, 2)
    for n, ((name, values), colour) in enumerate(zip(speeds.items(), COLOURS, strict=True)):
        left.bar(np.array(COUNTS) + 0.27 * (n - 1), values, 0.25, color=colour, label=name)
    left.set(yscale="log", xticks=COUNTS, xlabel="tubes", ylabel="equilibria a second, one core")
    left.legend(frameon=False, fontsize=9, ncol=3, loc="upper center", bbox_to_anchor=(0.5, 1.12))
    for (count, (errors, times)), colour in zip(steps.items(), COLOURS[1:], strict=True):
        right.plot(times, errors, "o-", color=colour, ms=4, label=f"{count} tubes")
        at = STEPS_RAD.index(STEP_RAD)
        right.plot(times[at], errors[at], "o", ms=10, mfc="none", color=style.INK)
    right.plot([], [], "o", ms=10, mfc="none", color=style.INK, label="default step")
    right.set(
        xscale="log", yscale="log", xlabel="CPU time of an equilibrium, us", ylabel="error of the tip, mm"
    )
    right.legend(frameon=False, fontsize=9)
    for axes in (left, right):
        axes.spines[["top", "right"]].set_visible(False)
    figure.tight_layout()
    return figure


def main() -> None:
    """Run the study and store its result."""
    options = study_parser(__doc__).parse_args()
    many, few = (1000, 40) if options.quick else (4000, 200)
    result = Result(
        name="tube_speed", title="Mechanics of concentric tubes", setting=setting_of(options),
        seeds=[options.seed],
        conditions={
            "tubes": "nested, "
            + ", ".join(f"{tube.length_mm:g}" for tube in mechanics(COUNTS[-1]).tubes)
            + " mm long, each curved over 40 mm by 0.006 per mm, which never snap",
            "configurations": f"{many} drawn at random, {few} for CasADi and for one by one",
            "time": "CPU time of one core, kernels compiled before, median of five runs",
        },
    )  # fmt: skip
    speeds = add_speed(result, many, few)
    add_random_designs(result, many)
    steps = add_steps(result, many)
    if data_folder() is None:
        result.not_reproduced.append("Differences from stored reference tips: LUNGACCESS_DATA is not set.")
    else:
        add_reference(result)
    result.figure = draw(speeds, steps)
    write_result(result, options.results)


if __name__ == "__main__":
    main()
