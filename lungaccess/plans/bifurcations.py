"""The bifurcations on the way of a plan's scope: which openings the picture shows, and which one to take."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np

from anatomy.airway_tree import AirwayTree
from anatomy.base.records import frozen_value
from anatomy.base.typed import Bool, Float, Int
from anatomy.lobes import LOBES
from anatomy.lung import Lung
from lungaccess.plans.clock_face import STRAIGHT_AHEAD, clock_hour, clock_words
from stages.scope import ScopeMotion

BEFORE_MM = 5.0
"""The tip is stopped so far before a bifurcation: both openings are then in a picture of 96 degrees."""
OPENING_MM = 5.0
"""An opening is where its branch is so far beyond the bifurcation, or at its end if it is shorter."""
TOGETHER_MM = 10.0
"""Branches of the same parent that part within so many mm are openings of one bifurcation."""
ORDINALS = ("first", "second", "third", "fourth", "fifth", "sixth")


@frozen_value
class Opening:
    """One way on at a bifurcation.

    Parameters
    ----------
    branch : int
        Of the airway tree; that of the parent where it goes on itself.
    label : str
        Short name for a picture.
    name : str
        Number and generation, and what the tree and the lobes of the patient support beyond them.
    place_lps : tuple of float
        Centre of the lumen in the opening, LPS mm.
    hour : int
        Where it is in the picture on a clock, 1 to 12; 0 is straight ahead.
    side : str
        "on the left", "on the right", "at the top" or "at the bottom" of the picture, or "straight ahead".
    order : int
        Place among the openings of its side, the nearest to the scope first; 0 if it is alone there.
    taken : bool
        Whether the plan goes there.
    """

    branch: int
    label: str
    name: str
    place_lps: tuple[float, float, float]
    hour: int
    side: str
    order: int
    taken: bool

    @property
    def words(self) -> str:
        """Where it is, and what it is."""
        which = f"the {ORDINALS[min(self.order, len(ORDINALS)) - 1]} " if self.order else "the one "
        at = "" if self.side == STRAIGHT_AHEAD else f", {clock_words(self.hour)}"
        return f"{which}{self.side}{at}: {self.name}"


@frozen_value
class Bifurcation:
    """A bifurcation of the route, and the state of the scope before it.

    Parameters
    ----------
    number, count : int
        Of how many on the route it is which, from 1.
    from_carina_mm : float
        Where it is along the tree; 0 is the carina itself.
    state : int
        State of the motion in which the tip stands before it.
    entered_state : int
        First state in which the tip is past it; the last one if it never is.
    inserted_mm : float
        Advance of the scope there.
    openings : tuple of Opening
        The one that is taken first.
    """

    number: int
    count: int
    from_carina_mm: float
    state: int
    entered_state: int
    inserted_mm: float
    openings: tuple[Opening, ...]

    @property
    def text(self) -> str:
        """Say in a sentence which opening to take."""
        taken, *others = self.openings
        where = (
            f"{self.from_carina_mm:.0f} mm beyond the carina" if round(self.from_carina_mm) else "the carina"
        )
        rest = f" Not {'; not '.join(one.words for one in others)}." if others else ""
        return (
            f"Bifurcation {self.number} of {self.count}, {where}, {self.inserted_mm:.0f} mm inserted: "
            f"take {taken.words}.{rest}"
        )

    def as_json(self) -> dict[str, object]:
        """Return the bifurcation as plain values, with its sentence."""
        return {**asdict(self), "text": self.text}


def route_bifurcations(motion: ScopeMotion, branches: Int, lung: Lung) -> tuple[Bifurcation, ...]:
    """Return the bifurcations on a route, from the trachea on.

    Hours are those of the picture, whose top is where a positive bend turns the tip, in the state in which
    the tip is first `BEFORE_MM` before the bifurcation, or as soon as it is past the one before.

    Parameters
    ----------
    motion : ScopeMotion
        With so many states that the tip moves little between them.
    branches : (B,) int64
        Of the airway tree, from the trachea to where the tip ends.
    """
    tree, tips = lung.tree, motion.tips
    depth = tree.distance_from_root_mm
    passed = depth[_places(tree, int(branches[-1]), tips[:, :3, 3])]
    forks = [_fork(tree, int(branch)) for branch in branches[1:]]
    found, entered = [], 0
    for number, (fork, parent, child) in enumerate(
        zip(forks, branches[:-1], branches[1:], strict=True), start=1
    ):
        state = max(_first(passed >= depth[fork] - BEFORE_MM), entered)
        entered = max(_first(passed >= depth[fork]), state)
        found.append(
            Bifurcation(
                number=number,
                count=len(forks),
                from_carina_mm=float(depth[fork] - depth[tree.carina_point]),
                state=state,
                entered_state=entered,
                inserted_mm=float(motion.states[state, 0]),
                openings=_openings(lung, tips[state], int(parent), int(child)),
            )
        )
    return tuple(found)


def _first(true: Bool) -> int:
    """Return the first true state, the last one if none is."""
    return int(np.argmax(true)) if true.any() else len(true) - 1


def branch_label(tree: AirwayTree, branch: int) -> str:
    """Return the short name of a branch."""
    if branch == 0:
        return "trachea"
    if tree.mediastinal[branch]:
        return f"{_side(tree, branch)} main"
    return tree.bronchi.names[branch] or f"branch {branch}"


def branch_name(lung: Lung, branch: int) -> str:
    """Return what is known of a branch: number and generation, a main bronchus by its side, else its lobe.

    A lobe is named only where the bronchus has no name, and all ends at or beyond the branch lie in it.
    """
    tree = lung.tree
    known = f"branch {branch}, generation {int(tree.generation[branch])}"
    if branch == 0:
        return f"the trachea ({known})"
    if tree.mediastinal[branch]:
        return f"the {_side(tree, branch)} main bronchus ({known})"
    if words := tree.bronchi.words(branch):
        return f"{words} ({known})"
    lobes = {_lobe(lung, end) for end in _ends(tree, branch)}
    return f"{known}, to the {lobes.pop()}" if len(lobes) == 1 and "" not in lobes else known


def _side(tree: AirwayTree, branch: int) -> str:
    end = tree.points_lps[tree.branch_points(branch)[-1]]
    return "left" if end[0] > tree.carina_lps[0] else "right"


def _ends(tree: AirwayTree, branch: int) -> Float:
    """Return the last points `(N, 3)` of the branches without children at or beyond a branch."""
    beyond = np.zeros(tree.n_branches, dtype=np.bool_)
    beyond[branch] = True
    for each in range(branch + 1, tree.n_branches):
        beyond[each] = beyond[tree.branch_parent[each]]
    leaves = tree.leaf_branches[beyond[tree.leaf_branches]]
    return tree.points_lps[tree.branch_start[leaves + 1] - 1]


def _lobe(lung: Lung, point_lps: Float) -> str:
    if lung.lobes is None:
        return ""
    number = int(lung.lobes.at(point_lps, 0))
    return LOBES[number] if number else lung.lobe_at(point_lps)


def _fork(tree: AirwayTree, branch: int) -> int:
    return int(tree.parent_point[tree.branch_start[branch]])


def _places(tree: AirwayTree, last: int, tips_lps: Float) -> Int:
    """Return for each tip the nearest tree point on the route to the end of a branch, never going back."""
    route = tree.route(int(tree.branch_start[last + 1]) - 1)
    away = np.linalg.norm(tips_lps[:, None] - tree.points_lps[route][None], axis=2)
    return np.asarray(route[np.maximum.accumulate(np.argmin(away, axis=1))])


def _openings(lung: Lung, lps_from_tip: Float, parent: int, child: int) -> tuple[Opening, ...]:
    tree = lung.tree
    depth, fork = tree.distance_from_root_mm, _fork(tree, child)
    others = [
        each
        for each in tree.children(parent).tolist()
        if each != child and abs(depth[_fork(tree, each)] - depth[fork]) <= TOGETHER_MM
    ]
    firsts = [(each, _fork(tree, each), int(tree.branch_start[each])) for each in (child, *others)]
    if fork + 1 < tree.branch_start[parent + 1] and not any(
        _fork(tree, each) == tree.branch_start[parent + 1] - 1 for each in others
    ):
        firsts.append((parent, fork, fork + 1))
    seen = []
    for branch, from_point, first in firsts:
        points = np.arange(first, tree.branch_start[branch + 1])
        near = points[depth[points] <= depth[from_point] + OPENING_MM]
        place = tree.points_lps[near[-1] if len(near) else first]
        seen.append((branch, float(depth[from_point]), place, clock_hour(lps_from_tip, place)))
    sides = [_side_of_picture(hour) for *_, hour in seen]
    made = []
    for (branch, _depth, place, hour), side in zip(seen, sides, strict=True):
        same = sorted(
            (other[1], n) for n, (other, its) in enumerate(zip(seen, sides, strict=True)) if its == side
        )
        order = [seen[n][0] for _, n in same].index(branch) + 1 if len(same) > 1 else 0
        made.append(
            Opening(
                branch=branch,
                label=branch_label(lung.tree, branch),
                name=branch_name(lung, branch),
                place_lps=(float(place[0]), float(place[1]), float(place[2])),
                hour=hour,
                side=side,
                order=order,
                taken=branch == child,
            )
        )
    return tuple(made)


def _side_of_picture(hour: int) -> str:
    if hour == 0:
        return STRAIGHT_AHEAD
    if hour in (6, 12):
        return "at the top" if hour == 12 else "at the bottom"
    return "on the right" if hour < 6 else "on the left"
