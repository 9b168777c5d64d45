"""Join the three stages into a `Plan`, with exact clearances and costs."""

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from anatomy.base.errors import AnatomyError
from anatomy.base.typed import Float
from anatomy.lung import Lung
from anatomy.structures import BITS
from lungaccess.plans.candidate import (
    Candidate,
    fissure_chance,
    parts_in_tissue,
    wall_in_path_mm,
    with_tool_in_place,
)
from lungaccess.plans.costs import path_costs
from lungaccess.plans.insertion import scope_insertion
from lungaccess.plans.parts import DeployedShape, Exemption, NeedleArc, NeedlePath, TubeDeployment, WallExit
from lungaccess.plans.plan import Plan
from lungaccess.plans.version import software_kernels, software_version
from lungaccess.plans.window import BreathingAim
from lungaccess.problem.system import System, system_fingerprint
from lungaccess.problem.task import Task
from stages.needle import ArcPath, InTissue
from stages.scope import prove_motion
from stages.tube import Deployment

SAMPLE_MM = 0.05
"""Spacing of the samples of a clearance, which is lowered by half of it to hold between them."""


def assemble(task: Task, candidate: Candidate, *, iteration: int, timing: Mapping[str, float]) -> Plan:
    """Return the plan of a candidate; AnatomyError if its scope's motion is not proved, as it has to be."""
    system, lung = task.system, task.lung
    frame, deployment, needle = candidate.tip.lps_from_scope_tip, candidate.deployment, system.needle
    path, of_needle = with_tool_in_place(system, candidate.path), {}
    tip, margin_mm = candidate.tip, prove_motion(lung, system.scope, candidate.tip.motion)
    if isinstance(margin_mm, str):
        raise AnatomyError(f"The motion of the scope is not proved: {margin_mm}")
    margin_mm += system.scope.lumen_margin_mm
    if needle is not None:
        of_needle = {"needle": needle_clearance_mm(task, path, deployment.branch)}
    return Plan(
        software_version=software_version(),
        kernels=software_kernels(),
        patient_name=lung.name,
        lung_key=lung.key,
        sources=lung.sources,
        breath_hold=lung.breath_hold,
        system=system,
        system_fingerprint=system_fingerprint(system),
        target_lps=task.target.lps_mm,
        target_origin=task.target.origin,
        fissures_are_obstacles=task.with_fissures,
        objective=str(task.objective),
        scope=scope_insertion(tip.motion, lung.tree, tip.tree_point, margin_mm),
        tube=tube_part(task, frame, deployment),
        needle=None if needle is None else needle_part(path),
        exemption=Exemption(
            branch=deployment.branch,
            exit_point_lps=deployment.exit_point(frame),
            needle_length_mm=0.0 if needle is None else needle.exit_exemption_mm,
        ),
        required_clearance_mm=required_clearance_mm(system),
        clearance_mm={"tube": tube_clearance_mm(task, frame, deployment)} | of_needle,
        fissure_chance=fissure_chance(system, lung, frame, deployment, path),
        costs=stated_costs(task, frame, deployment, path),
        method=task.method,
        needle_planner=task.needle_planner,
        seed=task.seed,
        iterations=iteration,
        timing=timing,
        aim=_aim_of_tool(system, path),
    )


def _aim_of_tool(system: System, path: ArcPath) -> BreathingAim | None:
    """Return where a path ends whose tool is at the target as the aim of a plan; None without a tool."""
    if system.tool is None:
        return None
    return BreathingAim(point_lps=path.frames()[-1][:3, 3], phases=np.zeros((0, 2)))


def with_devices(task: Task, candidate: Candidate, model: Plan) -> Plan:
    """Return a plan whose scope tip, tubes and needle are those of a candidate.

    What takes long to state is that of another plan: clearances, costs and the margin of the scope's motion.
    """
    frame, deployment = candidate.tip.lps_from_scope_tip, candidate.deployment
    tube = tube_part(task, frame, deployment)
    path = with_tool_in_place(task.system, candidate.path)
    needle = None if task.system.needle is None else needle_part(path)
    exemption = replace(model.exemption, branch=deployment.branch, exit_point_lps=tube.exit.point_lps)
    scope = replace(model.scope, lps_from_scope_tip=frame)
    aim = _aim_of_tool(task.system, path)
    chance = fissure_chance(task.system, task.lung, frame, deployment, path)
    return replace(
        model, scope=scope, tube=tube, needle=needle, exemption=exemption, aim=aim, fissure_chance=chance
    )


def required_clearance_mm(system: System) -> dict[str, float]:
    """Return the radius and margins of each device in tissue by its name in a plan."""
    margin, tubes = system.margins.total_mm, system.tubes
    required = {
        "outer_tube": tubes.outermost.radius_mm + margin,
        **{f"{name}_tube": tube.radius_mm + margin for name, tube in tubes.named},
    }
    if system.needle is not None:
        required["needle"] = system.needle.radius_mm + margin
    return required


def stated_costs(
    task: Task, lps_from_scope_tip: Float, deployment: Deployment | None, path: ArcPath
) -> dict[str, float]:
    """Return the costs of a path beyond a deployment, or of its tubes, as a plan states them.

    Without a deployment they are those of a needle alone, from tubes of which nothing is known.  The cost of
    all in tissue is stated where the objective weighs it.
    """
    wall_mm = 0.0 if deployment is None else wall_in_path_mm(task.system, deployment)
    if task.objective.tissue == 0.0:
        parts = None
    elif deployment is not None:
        parts = parts_in_tissue(task.system, lps_from_scope_tip, deployment, path)
    else:
        parts = [InTissue(path, task.system.require_needle("A path of the needle alone").diameter_mm)]
    found = path_costs(task.lung, path, with_fissures=task.with_fissures, wall_mm=wall_mm, parts=parts)
    return task.objective.stated(found)


def tube_part(task: Task, lps_from_scope_tip: Float, deployment: Deployment) -> TubeDeployment:
    """Return the part of a plan that a deployment from a scope tip makes."""
    tubes, shape = task.system.tubes, deployment.shape
    return TubeDeployment(
        rotation_rad=deployment.rotation_rad,
        outer_insertion_mm=0.0 if tubes.outer is None else deployment.outer_mm,
        middle_insertion_mm=0.0 if tubes.middle is None else float(shape.insertions_mm[1]),
        inner_insertion_mm=deployment.inner_mm,
        lps_from_tip=deployment.lps_from_tip,
        exit=WallExit(
            branch=deployment.branch,
            point_lps=deployment.exit_point(lps_from_scope_tip),
            arc_length_mm=deployment.exit_mm,
            wall_angle_rad=deployment.wall_angle_rad,
            wall_run_mm=deployment.wall_run_mm,
        ),
        lateral_sweep_mm=deployment.lateral_sweep_mm,
        follow_the_leader_error_mm=shape.follow_the_leader_error_mm,
        shape=DeployedShape.of(tubes, shape),
    )


def needle_part(path: ArcPath) -> NeedlePath:
    """Return the part of a plan that a path makes."""
    return NeedlePath(
        lps_from_start=path.lps_from_start,
        arcs=tuple(
            NeedleArc(length_mm=float(length), roll_rad=float(roll), curvature_per_mm=float(curvature))
            for length, roll, curvature in path.arcs
        ),
        end_lps=path.frames()[-1][:3, 3],
        length_mm=path.length_mm,
        max_angle_from_start_rad=path.max_angle_from_start_rad(),
        accumulated_turn_rad=path.accumulated_turn_rad,
    )


def tube_clearance_mm(task: Task, lps_from_scope_tip: Float, deployment: Deployment) -> dict[str, float]:
    """Return the smallest distance of the tube's axis from each structure, beyond the exit."""
    begin, end = deployment.exit_mm, deployment.inner_mm
    count = max(2, math.ceil((end - begin) / SAMPLE_MM) + 1)
    points = deployment.points(lps_from_scope_tip, np.linspace(begin, end, count))
    return {name: _least_clearance(task.lung, points, name, deployment.branch) for name in _structures(task)}


def needle_clearance_mm(task: Task, path: ArcPath, branch: int) -> dict[str, float]:
    """Return the smallest distance of the needle's axis from each structure.

    From the airway beyond the exempt length; where the needle ends before that, only other branches count.
    """
    points, lengths = path.sample(SAMPLE_MM)
    needle = task.system.require_needle("The clearance of a needle")
    beyond = lengths >= needle.exit_exemption_mm - 0.5 * SAMPLE_MM
    out = {}
    for name in _structures(task):
        if name == "airway":
            parts = [_least_clearance(task.lung, points, name, branch)]
            if beyond.any():
                parts.append(_least_clearance(task.lung, points[beyond], name, -1))
            out[name] = min(parts)
        else:
            out[name] = _least_clearance(task.lung, points, name, -1)
    return out


def _structures(task: Task) -> tuple[str, ...]:
    return ("airway", "vessel", "outside", *(("fissure",) if task.lung.has_fissures else ()))


def _least_clearance(lung: Lung, points: Float, name: str, exempt_branch: int) -> float:
    """Return a distance that the curve through `points` never falls below.

    Exact distances below 5 mm, else the field's lower bound; between two samples the distance is at
    most half their spacing less.
    """
    field = "pleura" if name == "outside" else name
    # Clearances below this are stated exactly: larger ones never limit a plan.
    least = lung.least_clearance_mm(points, field, BITS[name], cap_mm=5.0, exempt_branch=exempt_branch)
    return max(least - 0.5 * SAMPLE_MM, 0.0)
