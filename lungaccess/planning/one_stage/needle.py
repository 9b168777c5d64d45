"""The needle stage alone, from a pose to a target, with any of its planners; and what stands in its way."""

import math
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import cache
from typing import Any

import numpy as np

from anatomy.base.errors import SettingsError, TargetError
from anatomy.base.kernel_clock import working_s
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from anatomy.base.words import point_in_words
from anatomy.kernels.field import exact_distance
from anatomy.liver import with_entry
from anatomy.lung import Lung
from anatomy.morphology import voxels_in
from anatomy.organ import Organ
from anatomy.structures import AIRWAY, BRANCH_SHIFT, FISSURE, LUMEN, OUTSIDE, VESSEL
from lungaccess.plans.costs import known_costs
from lungaccess.problem.system import System, load_system, needle_preset_names, preset_names
from lungaccess.problem.target import Target
from stages import needle as stage

NAMES = ((VESSEL, "a vessel"), (FISSURE, "a fissure"), (OUTSIDE, "the outside of the organ"))
LIMITS = {
    "angle": "lies too far aside of straight ahead for the limit of the angle from the start",
    "turn": "lies too far aside of straight ahead for the limit of all turning",
    "length": "is farther than the needle is long",
}


def _structure_in_words(label: int) -> str:
    """Return the structure that a voxel label stands for, with the branch of an airway."""
    if label & AIRWAY:
        branch = (label >> BRANCH_SHIFT) - 1
        return "an airway" if branch < 0 else f"the airway (branch {branch})"
    return next((name for bit, name in NAMES if label & bit), "nothing")


def reason_in_words(found: stage.Obstruction) -> str:
    """Return in a few words what is blocked, by what, and by how much."""
    if found.place == "reach":
        if found.limit != "radius":
            return f"target out of reach: it {LIMITS[found.limit]}"
        if found.radius_mm is None:
            return "target out of reach, whatever the radius of curvature"
        # Rounded down, so that the radius named does reach it.
        radius_mm = math.floor(10.0 * found.radius_mm) / 10.0
        return f"target out of reach of this radius: needs R <= {radius_mm:.1f} mm{_needle_with(radius_mm)}"
    what = {"start": "start blocked", "target": "target blocked"}.get(found.place, "path blocked")
    return (
        f"{what} by {_structure_in_words(found.label)}: "
        f"{found.distance_mm:.2f} mm away, needs {found.needed_mm:.2f} mm"
    )


@cache
def _bundled_radii_mm() -> dict[str, float]:
    """Return the least radius of curvature of the needle of each system that ships, by its name."""
    systems = [load_system(name) for name in (*preset_names(), *needle_preset_names())]
    return {each.name: each.needle.min_radius_of_curvature_mm for each in systems if each.needle is not None}


def _needle_with(radius_mm: float) -> str:
    """Name the system with the gentlest needle that turns within a radius; "" if none that ships does."""
    radii = _bundled_radii_mm()
    name = max((each for each in radii if radii[each] <= radius_mm), key=lambda each: radii[each], default="")
    return f", which --system {name} has ({radii[name]:g} mm)" if name else ""


def obstruction_rows(found: stage.Obstruction, proved: bool, lobe: str = "") -> list[tuple[str, str]]:
    """Return what a table says of an obstruction, the reason first."""
    rows = [("reason", reason_in_words(found))]
    if found.place == "reach":
        direction = f"{math.degrees(found.direction_rad):.1f} deg off straight ahead"
        rows.append(("target seen from the start", f"{found.straight_mm:.1f} mm away, {direction}"))
    elif found.place == "path":
        rows.append(("where", f"the tightest place of the easiest path tried, {_place(found)}"))
    else:
        rows.append(("where", _place(found)))
    if lobe:
        rows.append(("lobe", lobe))
    rows.append(("proved", "yes: no path exists" if proved else "no: a path may exist"))
    return rows


def _place(found: stage.Obstruction) -> str:
    along = "" if found.inserted_mm is None else f"{found.inserted_mm:.1f} mm along the needle, "
    return f"{along}at {point_in_words(found.point_lps)}"


def _obstruction_record(found: stage.Obstruction, proved: bool, lobe: str = "") -> dict[str, Any]:
    """Return plain JSON values: points in both frames, mm, angles in rad."""
    x, y, z = (float(v) for v in found.point_lps)
    branch = (found.label >> BRANCH_SHIFT) - 1
    return {
        "what": found.place,
        "reason": reason_in_words(found),
        "proved": proved,
        "structure": _structure_in_words(found.label) if found.label else None,
        "branch": branch if found.label & AIRWAY and branch >= 0 else None,
        "lobe": lobe or None,
        "point_lps_mm": [x, y, z],
        "point_ras_mm": [-x, -y, z],
        "obstacle_lps_mm": None if found.obstacle_lps is None else found.obstacle_lps.tolist(),
        "inserted_mm": found.inserted_mm,
        "distance_mm": found.distance_mm,
        "needed_distance_mm": found.needed_mm,
        "limit": found.limit or None,
        "needed_radius_mm": found.radius_mm,
        "target_direction_rad": found.direction_rad,
        "target_distance_mm": found.straight_mm,
    }


SLICE = 500
"""Iterations between two looks at the clock: some milliseconds."""


@frozen_record
class PathSearch:
    """What one search found: the best path and the first one, proved clear and within all limits.

    Args:
        outcome: "path"; "no path", if there is a proof; a search's own words for its end; else "nothing
            found".
        cost: Of the path under the objective, as estimated within the search.
        open_passage: Where a path would have to pass, if neither a path nor a proof that there is none was
            found.
    """

    outcome: str
    path: stage.ArcPath | None = None
    first_path: stage.ArcPath | None = None
    cost: float = math.inf
    first_path_s: float | None = None
    obstruction: stage.Obstruction | None = None
    open_passage: stage.Passage | None = None

    @property
    def proved(self) -> bool:
        """Whether it is proved that no path exists."""
        return self.outcome == "no path"


def search_path(
    environment: stage.NeedleEnvironment,
    query: stage.Query,
    planner: str,
    *,
    objective: stage.Objective = stage.SHORTEST,
    seed: int | None = 0,
    iterations: int | None = None,
    time_s: float | None = None,
    clock: Callable[[], float] = working_s,
    portion: int = SLICE,
) -> PathSearch:
    """Search a path; what is proved to have none at reach, start or target is not searched.

    Args:
        planner: One of `stages.needle.NEEDLE_PLANNERS`; those of OMPL end by time alone.
        seed: OMPL can be seeded once in a process; without a seed, its planners draw anew at each call.
        iterations, time_s (optional): The search ends by whichever comes first, or by itself.
        clock: Returns seconds: of the wall without compilation of kernels, or of this process.
        portion: Iterations between two looks at the clock.
    """
    blocked = stage.find_obstruction(environment, query)
    if blocked is not None and blocked.proved:
        return PathSearch(outcome="no path", obstruction=blocked)
    if planner in stage.OMPL_PLANNERS:
        found = _by_ompl(environment, query, planner, seed, time_s or 0.0, clock)
    else:
        search = stage.searches()[planner](environment, query, seed or 0, objective)
        found = _advance(search, iterations, time_s, clock, portion)
    if found.path is not None:
        return found
    return replace(found, obstruction=blocked or stage.easiest_obstruction(environment, query))


def _advance(
    search: stage.Search,
    iterations: int | None,
    time_s: float | None,
    clock: Callable[[], float],
    portion: int,
) -> PathSearch:
    first, first_path_s = None, None
    began, left = clock(), iterations
    while not search.finished and (left is None or left > 0):
        if time_s is not None and clock() - began >= time_s:
            break
        count = portion if left is None else min(portion, left)
        search.advance(count)
        left = None if left is None else left - count
        if first is None and search.path is not None:
            first, first_path_s = search.path, clock() - began
    stated = str(getattr(search, "outcome", "running"))
    unstated = "nothing found" if search.path is None else "path"
    return PathSearch(
        outcome=unstated if stated == "running" else stated,
        path=search.path,
        first_path=first,
        cost=search.cost,
        first_path_s=first_path_s,
        open_passage=getattr(search, "passage", None),
    )


def _by_ompl(
    environment: stage.NeedleEnvironment,
    query: stage.Query,
    planner: str,
    seed: int | None,
    time_s: float,
    clock: Callable[[], float],
) -> PathSearch:
    """Let a planner of OMPL search; its cost is the length of the path."""
    from stages.needle.ompl import NeedleProblem, seed_ompl

    if seed is not None:
        seed_ompl(seed + 1)
    problem = NeedleProblem(environment)
    problem.setup.setPlanner(problem.planners()[planner](problem.si))
    problem.pose(query, goal_tolerance_mm=max(stage.OMPL_TOLERANCE_MM, environment.goal_tolerance_mm))
    began = clock()
    problem.setup.solve(time_s)
    first_path_s = clock() - began
    path = problem.solution()
    if path is None:
        return PathSearch(outcome="nothing found")
    return PathSearch(
        outcome="path", path=path, first_path=path, cost=path.length_mm, first_path_s=first_path_s
    )


WALL_MM = 3.0
"""A start so near to an airway is taken to have pierced its wall."""


@frozen_record
class NeedleQuestion:
    """A start and a target in a lung as the needle stage takes them.

    Args:
        branches: Branches whose wall the start is taken to have pierced, the nearest first; none if no airway
            is near.
        at_wall: Whether the needle begins so near to the lumen that it pierces the wall itself.
    """

    environment: stage.NeedleEnvironment
    query: stage.Query
    branches: tuple[int, ...]
    at_wall: bool


@frozen_record
class NeedleAnswer(PathSearch, NeedleQuestion):
    """What a planner found, and what it was asked; planners of OMPL look at no objective.

    `lobe` is where what stands in the way lies; "" if the lobes are not known.
    """

    lobe: str
    objective: stage.Objective

    @property
    def branch(self) -> int:
        """The branch that is exempt at the exit; -1 for none."""
        return self.branches[0] if self.branches else -1

    @property
    def costs(self) -> dict[str, float]:
        """Every cost of the path by its key, and that under the objective by its text; empty without a path.

        Exact, and evaluated at every call.
        """
        if self.path is None:
            return {}
        parts = [stage.InTissue(self.path, self.environment.needle.diameter_mm)]
        return self.objective.stated(
            stage.path_costs(self.environment.obstacles, self.environment.cost_map, self.path, parts)
        )

    @property
    def known_costs(self) -> dict[str, float | None]:
        """The same, None for costs of the map where there is none."""
        return known_costs(self.costs, has_map=self.environment.cost_map is not None)

    def record(self) -> dict[str, Any]:
        """Return plain JSON values; poses in LPS mm, angles in rad."""
        path = self.path
        record: dict[str, Any] = {
            "outcome": self.outcome,
            "no_path_is_proved": self.proved,
            "pierced_branches": list(self.branches),
            "begins_at_the_wall": self.at_wall,
            "blocked": None,
            "open_passage": None if self.open_passage is None else asdict(self.open_passage),
            "path": None,
        }
        if self.obstruction is not None:
            record["blocked"] = _obstruction_record(self.obstruction, self.proved, self.lobe)
        if path is not None:
            record["path"] = {
                "first_path_s": self.first_path_s,
                "length_mm": path.length_mm,
                "max_angle_from_start_rad": path.max_angle_from_start_rad(),
                "accumulated_turn_rad": path.accumulated_turn_rad,
                "costs": self.known_costs,
                "lps_from_start": path.lps_from_start.tolist(),
                "arcs": path.arc_records(),
            }
        return record


def plan_needle(
    lung: Organ,
    system: System,
    lps_from_start: Float,
    target: Target,
    *,
    planner: str = "decide",
    objective: str | stage.Objective = "length",
    seed: int = 0,
    iterations: int | None = None,
    time_s: float | None = None,
) -> NeedleAnswer:
    """Plan the needle of a system, with its margins, from a pose `(4, 4)`, +z forward, to a target.

    Parameters are those of `search_path`, and a limit is needed.  A planner of OMPL needs a process of its
    own.

    Raises:
        SettingsError: If there is no such planner or objective, no limit, or a cost map is missing; if OMPL
            has been used in this process.
        TargetError: If the start lies outside the images, or the target is its point.
    """
    weighed = stage.Objective.of(objective)
    stage.require_planner(planner)
    if time_s is None and (iterations is None or planner in stage.OMPL_PLANNERS):
        raise SettingsError(
            f"The needle search {planner} has no limit",
            expected="a time in seconds"
            if planner in stage.OMPL_PLANNERS
            else "iterations or a time in seconds",
        )
    if not lung.grid.contains(lps_from_start[:3, 3]).all():
        raise TargetError(
            f"The start lies outside the images, at LPS {lps_from_start[:3, 3].round(1).tolist()}",
            expected="a pose inside the lung",
            remedy="Check the frame of its numbers: RAS or LPS",
        )
    asked = needle_question(lung, system, lps_from_start, target.lps_mm)
    found = search_path(
        asked.environment,
        asked.query,
        planner,
        objective=weighed,
        seed=seed,
        iterations=iterations,
        time_s=time_s,
    )
    blocked = found.obstruction
    return NeedleAnswer(
        **vars(found),
        **vars(asked),
        lobe=lung.lobe_at(blocked.point_lps) if blocked and isinstance(lung, Lung) else "",
        objective=weighed,
    )


def needle_question(lung: Organ, system: System, lps_from_start: Float, target_lps: Float) -> NeedleQuestion:
    """Ask for a path of a needle, its start `(4, 4)` with its exemption; TargetError if it starts there."""
    # The searches take no shorter arc.
    if np.linalg.norm(lps_from_start[:3, 3] - target_lps) < 1e-6:
        raise TargetError(
            "The needle starts at its target, so there is nothing to insert",
            expected="a target away from the start",
            remedy="Check that start and target are those of the question",
        )
    needle, point = system.require_needle("A path of the needle"), lps_from_start[:3, 3]
    if not isinstance(lung, Lung) and lung.exact_clearance_mm(point, OUTSIDE, cap_mm=WALL_MM)[0] < WALL_MM:
        # The surface of an organ is pierced at a start as near as this.
        reach_mm = needle.exit_exemption_mm + needle.radius_mm + system.margins.total_mm
        lung = with_entry(lung, point, reach_mm)
    environment = stage.needle_environment(
        lung, needle, system.margins, with_fissures=not system.fissures_allowed
    )
    branches = pierced_branches(lung, point, environment.required_clearance_mm)
    at_wall = bool(lung.exact_clearance_mm(point, LUMEN, cap_mm=needle.radius_mm)[0] < needle.radius_mm)
    if at_wall:
        environment = stage.begun_at_wall(environment, point, branches)
    query = stage.Query(lps_from_start=lps_from_start, target=target_lps, branch=[*branches, -1][0])
    return NeedleQuestion(environment=environment, query=query, branches=branches, at_wall=at_wall)


def pierced_branches(lung: Organ, point: Float, near_mm: float) -> tuple[int, ...]:
    """Return the airway branches that a needle at a point `(3,)` LPS mm has pierced, the nearest first.

    The nearest lies within `WALL_MM`.  Near a junction the tree draws the line between branches, not the
    anatomy: those that meet the nearest one and come within `near_mm` of the point are pierced with it.
    """
    x, y, z = (float(c) for c in point)
    _distance, label = exact_distance(lung.labels, lung.geometry, x, y, z, AIRWAY, -1, WALL_MM)
    branch = (int(label) >> BRANCH_SHIFT) - 1
    if branch < 0:
        return ()
    around = lung.labels[lung.grid.window(point, near_mm)]
    others = np.setdiff1d((around[(around & AIRWAY) != 0] >> BRANCH_SHIFT).astype(int) - 1, [-1, branch])
    meeting = {int(b) for b in others} & _meeting(lung, branch) if isinstance(lung, Lung) else set()
    return (branch, *(b for b in sorted(meeting) if _is_near(lung, point, b, near_mm)))


def _meeting(lung: Lung, branch: int) -> set[int]:
    """Return the parent, the children, and the other children of the parent of a branch."""
    parent = int(lung.tree.branch_parent[branch])
    of_parent = [] if parent < 0 else [parent, *lung.tree.children(parent)]
    return {int(b) for b in (*lung.tree.children(branch), *of_parent)} - {branch}


def _is_near(lung: Organ, point: Float, branch: int, near_mm: float) -> bool:
    """Tell whether airway voxels of a branch, as boxes, come within `near_mm` of a point."""
    part = lung.grid.window(point, near_mm)
    labels = lung.labels[part]
    of_branch = ((labels & AIRWAY) != 0) & ((labels >> BRANCH_SHIFT).astype(int) - 1 == branch)
    return bool((lung.grid.box_distance_mm(voxels_in(part, of_branch), point) < near_mm).any())
