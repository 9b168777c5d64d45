"""Plan a tour of the airway to several lesions of one patient."""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from anatomy.base.errors import FileError, TargetError
from anatomy.base.files import read_text
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from anatomy.io.frames import parse_point
from anatomy.lung import Lung
from lungaccess.planning.coupled.atlas import Atlas
from lungaccess.planning.one_system import run
from lungaccess.plans.no_plan import NoPlan
from lungaccess.problem.request import Request
from lungaccess.problem.target import Target
from stages.needle import DEFAULT
from stages.scope import tour as tours

ITERATIONS = 100
"""Of the coupled planner for a lesion that no direct arc reaches: some seconds."""


@frozen_record
class TourAnswer:
    """Tours to M lesions; lesions without an exit are left out, with why.

    Args:
        least_resistance: The shortest tour over the exits of the circuit with the least resistance [Pan2025];
            None if there are too many combinations.
        one_by_one_mm: Length of a tour in which the scope returns to the root between any two lesions.
        plan_required: Whether an exit counted only if a coupled plan from there exists.
    """

    lesions_lps: Float
    numbers: tuple[int, ...]
    left_out: Mapping[int, str]
    subtree: tours.Subtree
    shortest: tours.Itinerary
    least_resistance: tours.Itinerary | None
    circuits: tours.Circuits | None
    one_by_one_mm: float
    plan_required: bool

    @property
    def title(self) -> str:
        """How many of the lesions the tours visit."""
        visited = len(self.lesions_lps)
        if not self.left_out:
            return f"tour to {visited} lesions"
        return f"tour to {visited} of {visited + len(self.left_out)} lesions"


def read_lesions(path: str | Path) -> Float:
    """Read lesions from a text file, one `ras:x,y,z` or `lps:x,y,z` a line; return `(M, 3)` LPS mm.

    Empty lines, and what follows a `#`, are passed over.

    Raises:
        FileError: If the file cannot be read or names no lesion, or more than 62.
        FrameError: If a line states no frame.
    """
    lines = [line.split("#")[0].strip() for line in read_text(path).splitlines()]
    points = [parse_point(line) for line in lines if line]
    if not 1 <= len(points) <= tours.MOST_LESIONS:
        raise FileError(
            f"{path} names {len(points)} lesions",
            expected=f"1 to {tours.MOST_LESIONS}, one a line",
            remedy="Write lines such as lps:-57,131,-520",
        )
    return np.array(points)


def lesions_of(lung: Lung) -> Float:
    """Return a patient's targets, `(M, 3)` LPS mm; TargetError if none came with it, or more than 62."""
    count = len(lung.targets_lps)
    if not 1 <= count <= tours.MOST_LESIONS:
        raise TargetError(
            f"Patient {lung.name} came with {count} targets",
            expected=f"1 to {tours.MOST_LESIONS} lesions",
            remedy="Name them in a file for --targets; `lungaccess template lesions` prints an example",
        )
    return np.array(lung.targets_lps, dtype=np.float64)


def plan_tour(
    lung: Lung,
    lesions_lps: Float,
    *,
    rule: tours.ExitRule | None = None,
    weights: tours.Resistances | None = None,
    reading: tours.Reading = "printed",
    closed: bool = False,
    tissue_weight: float = 0.0,
    atlas: Atlas | None = None,
    iterations: int = ITERATIONS,
) -> TourAnswer:
    """Plan the shortest tour to all lesions `(M, 3)`, LPS mm, and the one by least resistance beside it.

    A lesion without an exit is left out of the tour, and named in the answer.  That no plan was found does
    not prove that there is none.  TargetError is raised if a lesion lies outside the image, or none has an
    exit.

    Args:
        rule: By default the paper's reach of 40 mm, or with an atlas that of tubes and needle together.
        reading: How resistances are merged: "printed" or "reduced", see `stages.scope.tour.subtree`.
        tissue_weight: How many mm of the scope's travel a mm between exit and lesion is worth.
        atlas: If given, an exit counts only if a coupled plan from there was found: see `coupled_plan_test`.
        iterations: Of the coupled planner for a lesion that no direct arc reaches; 0 for direct arcs alone.
    """
    lesions = np.asarray(lesions_lps, dtype=np.float64).reshape(-1, 3)
    for number, inside in enumerate(lung.grid.contains(lesions).tolist(), 1):
        if not inside:
            raise TargetError(
                f"Lesion {number} lies outside the image of {lung.name}",
                expected="a point in the lungs, in LPS mm",
                remedy="Check the frame of the coordinates",
            )
    chosen = rule or tours.ExitRule()
    if rule is None and atlas is not None:
        system, needle = atlas.system, atlas.system.needle
        reach = system.tubes.max_extension_mm + (0.0 if needle is None else needle.max_length_mm)
        # No exit farther from a lesion is of use: a lung is not wider.
        chosen = tours.ExitRule(reach_mm=min(reach, 200.0))
    exits: list[tuple[tours.Exit, ...]] = []
    numbers: list[int] = []
    left_out: dict[int, str] = {}
    for number, lesion in enumerate(lesions, 1):
        try:
            accepts = None if atlas is None else coupled_plan_test(atlas, lesion, iterations)
            exits.append(tours.exits_of(lung.tree, len(exits), lesion, chosen, accepts))
            numbers.append(number)
        except TargetError as error:
            left_out[number] = error.found
        except NoPlan as error:
            left_out[number] = f"no plan was found in {iterations} iterations: {error.main_reason}"
    if not exits:
        raise TargetError(
            "No lesion has an exit: " + "; ".join(f"{n}: {why}" for n, why in left_out.items()),
            remedy="Name other lesions, or plan a tour of the scope alone with --no-require-plan",
            expected="at least one lesion with an exit",
        )
    cost = [[tissue_weight * each.distance_mm for each in of_one] for of_one in exits]
    subtree = tours.subtree_to(lung.tree, exits, weights=weights, exit_cost_mm=cost)
    best = tours.shortest_tour(subtree, closed=closed)
    found = tours.circuits(subtree) if tours.combinations(subtree) <= tours.MOST_COMBINATIONS else None
    return TourAnswer(
        lesions_lps=lesions[np.array(numbers) - 1],
        numbers=tuple(numbers),
        left_out=left_out,
        subtree=subtree,
        shortest=best,
        least_resistance=None
        if found is None
        else tours.plan_itinerary(subtree, found.choice(reading), closed=closed),
        circuits=found,
        one_by_one_mm=tours.one_by_one_mm(subtree, best.chosen, closed=closed),
        plan_required=atlas is not None,
    )


def coupled_plan_test(atlas: Atlas, lesion_lps: Float, iterations: int = ITERATIONS) -> tours.ExitTest:
    """Return the test whether a coupled plan leads from a tree point to a lesion, `(3,)` LPS mm.

    All deployments of the atlas whose workspace holds the lesion are tried with the direct arc, or without a
    needle those that end nearby, aimed at it; a site counts if one of its best deployments is proved in full.
    Where none is, the coupled planner searches, and the sites of its plans count.  So a refused exit may
    still be possible.

    Raises:
        NoPlan: If no plan was found at all.
        TargetError: If the lesion lies outside the lung or inside an obstacle.
    """
    from lungaccess.problem.target import point_target

    target = point_target(atlas.lung, lesion_lps)
    good = _points_of_arcs(atlas, target)
    if not good:
        asked = Request.of(atlas.lung, atlas.system, target, goal=DEFAULT, iterations=iterations)
        plans = run(asked, atlas=atlas, counterfactuals=False)
        tips = np.stack([found.scope.lps_from_scope_tip[:3, 3] for found in plans])
        away = np.linalg.norm(atlas.lung.tree.points_lps[:, None] - tips, axis=2)
        good = frozenset(away.argmin(axis=0).tolist())
    return lambda _lesion, point: point in good


def _points_of_arcs(atlas: Atlas, target: Target) -> frozenset[int]:
    """Return the tree points from where a direct arc, or without a needle the tubes, reach a target."""
    from lungaccess.planning.coupled import direct_candidates
    from lungaccess.problem.task import Task
    from stages.needle import SHORTEST

    task = Task(lung=atlas.lung, system=atlas.system, target=target, objective=SHORTEST)
    direct = direct_candidates(task, atlas)
    clear = direct.clear()
    points = atlas.motions.tree_point[atlas.deployments.site[clear]]
    good, tried = set[int](), Counter[int]()
    for entry, point in zip(clear.tolist(), points.tolist(), strict=True):
        # How many deployments of a site are tried in full before the site counts as refused.
        if point not in good and tried[point] < 3:
            tried[point] += 1
            good |= set() if direct.proved(entry) is None else {point}
    return frozenset(good)


def tour_record(answer: TourAnswer) -> dict[str, Any]:
    """Return a tour as plain JSON types: points in LPS mm, lengths in mm, lesions counted from 1."""
    least = answer.least_resistance
    return {
        "lesions": [
            {"number": number, "lps_mm": place}
            for number, place in zip(answer.numbers, answer.lesions_lps.tolist(), strict=True)
        ],
        "left_out": {str(number): why for number, why in answer.left_out.items()},
        "exits_require_coupled_plans": answer.plan_required,
        "shortest": _itinerary_record(answer.shortest, answer.numbers),
        "least_resistance": None if least is None else _itinerary_record(least, answer.numbers),
        "circuits": None if answer.circuits is None else answer.circuits.count,
        "one_by_one_mm": answer.one_by_one_mm,
    }


def _itinerary_record(tour: tours.Itinerary, numbers: Sequence[int]) -> dict[str, Any]:
    subtree = tour.subtree
    return {
        "closed": tour.closed,
        "length_mm": tour.length_mm,
        "order": [numbers[lesion] for lesion in tour.order],
        "visits": [
            {
                "lesion": numbers[visit.lesion],
                "tree_point": visit.tree_point,
                "roles": list(visit.roles),
                "distance_mm": visit.distance_mm,
                "angle_rad": visit.angle_rad,
            }
            for visit in tour.visits
        ],
        "tree_points_in_order": [int(subtree.tree_point[v]) for v in tour.vertices()],
        "stretches": [
            {
                "from_tree_point": int(subtree.tree_point[subtree.parent[v]]),
                "to_tree_point": int(subtree.tree_point[v]),
                "length_mm": float(subtree.length_mm[v]),
                "passes": int(tour.passes[v]),
                "loops": int(tour.loops[v]),
            }
            for v in range(1, subtree.n_vertices)
            if tour.passes[v] > 0
        ],
    }
