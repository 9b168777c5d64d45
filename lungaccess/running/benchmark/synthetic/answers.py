"""Answers of a submission as motions of the devices: made from a plan of ours, and handed to the check."""

from typing import Any

import numpy as np

from anatomy.base.errors import SettingsError
from anatomy.base.typed import Float
from lungaccess.judging.checking.completion import Motions
from lungaccess.plans.parts import DeployedShape, NeedleArc
from lungaccess.plans.plan import Plan
from lungaccess.problem.system import load_system
from lungaccess.running.benchmark.synthetic.cases import BenchmarkQuery, PublishedTips
from lungaccess.running.benchmark.synthetic.submission import (
    ArcAnswer,
    NeedleAnswer,
    ScopeAnswer,
    SubmittedAnswer,
    TubesAnswer,
)
from stages.tube import ConcentricTubes, TubeShape, deployed, design_arrays, shape_of_arrays, without_limits


def answer_of_plan(query: BenchmarkQuery, plan: Plan, *, first_cpu_s: float, cpu_s: float) -> SubmittedAnswer:
    """Return the answer that a plan of our own makes: its motions, nothing of what it states beside them."""
    needle = plan.needle
    if needle is None:
        raise SettingsError(f"The plan for {query.name} has no needle", expected=f"a plan of {query.system}")
    return SubmittedAnswer(
        query=query.name,
        scope=ScopeAnswer(
            lps_from_entry=_pose(plan.scope.lps_from_entry),
            states=tuple((float(a), float(t), float(b)) for a, t, b in plan.scope.states),
            lps_from_tip=_pose(plan.scope.lps_from_scope_tip),
        ),
        tubes=TubesAnswer(
            rotation_rad=plan.tube.rotation_rad,
            outer_insertion_mm=plan.tube.outer_insertion_mm,
            inner_insertion_mm=plan.tube.inner_insertion_mm,
            lps_from_tip=_pose(plan.tube.lps_from_tip),
        ),
        needle=NeedleAnswer(
            arcs=tuple(
                ArcAnswer(
                    length_mm=arc.length_mm, roll_rad=arc.roll_rad, curvature_per_mm=arc.curvature_per_mm
                )
                for arc in needle.arcs
            )
        ),
        first_cpu_s=first_cpu_s,
        cpu_s=cpu_s,
    )


def _pose(matrix: Float) -> Any:
    return tuple(tuple(float(x) for x in row) for row in matrix)


def motions_of_answer(query: BenchmarkQuery, answer: SubmittedAnswer, tips: PublishedTips) -> Motions:
    """Return what the devices of an answer do.

    Raises:
        FileError: If the answer names a published tip and the file of tips cannot be read.
        SettingsError: If there is no tip of that number, or the answer is no plan.
    """
    scope, tubes, needle = answer.scope, answer.tubes, answer.needle
    if scope is None or tubes is None or needle is None:
        raise SettingsError(f"The answer to {query.name} is no plan", expected="scope, tubes, needle")
    devices = load_system(query.system).tubes
    shape = _shape(devices, tubes.outer_insertion_mm, tubes.inner_insertion_mm)
    entry, states, tip = scope.lps_from_entry, scope.states, scope.lps_from_tip
    if scope.tip is not None:
        published = tips.tip(query.phantom, query.system, scope.tip)
        entry, states = published["lps_from_entry"], published["states"]
        tip = published["lps_from_tip"] if tip is None else tip
    return Motions(
        lps_from_entry=np.array(entry, dtype=np.float64),
        states=np.array(states, dtype=np.float64).reshape(-1, 3),
        lps_from_scope_tip=np.array(tip, dtype=np.float64),
        rotation_rad=tubes.rotation_rad,
        outer_insertion_mm=tubes.outer_insertion_mm,
        inner_insertion_mm=tubes.inner_insertion_mm,
        shape=DeployedShape.of(devices, shape),
        lateral_sweep_mm=shape.lateral_sweep_mm,
        follow_the_leader_error_mm=shape.follow_the_leader_error_mm,
        lps_from_tube_tip=np.array(tubes.lps_from_tip, dtype=np.float64),
        arcs=tuple(
            NeedleArc(length_mm=arc.length_mm, roll_rad=arc.roll_rad, curvature_per_mm=arc.curvature_per_mm)
            for arc in needle.arcs
        ),
    )


def _shape(tubes: ConcentricTubes, outer_mm: float, inner_mm: float) -> TubeShape:
    """Return the shape that the mechanics give; where tubes cannot go, a straight one, which is refused."""
    n = len(tubes.nested)
    inserted, turned = np.array([inner_mm, outer_mm][:n]), np.zeros(n)
    made = deployed(without_limits(design_arrays(tubes)), inserted, turned)
    if made is not None:
        return shape_of_arrays(made)
    return TubeShape(
        insertions_mm=inserted,
        rotations_rad=turned,
        arcs=np.array([[max(inner_mm, 0.0), 0.0, 0.0, tubes.outermost.radius_mm]]),
        lateral_sweep_mm=0.0,
        follow_the_leader_error_mm=0.0,
        arc_error_mm=0.0,
        least_determinant=1.0,
    )
