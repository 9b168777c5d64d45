"""What is told of an opening is where a picture shows it that is made here, by small steps along rays."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

import lungaccess as la
from anatomy.build import build_lung
from anatomy.lung import Lung
from anatomy.phantom import make_phantom
from anatomy.structures import LUMEN
from lungaccess.plans import bifurcations
from lungaccess.plans.bifurcations import Bifurcation, Opening, route_bifurcations
from lungaccess.plans.insertion import SHOWN_STEP_MM, SHOWN_TURN_RAD
from lungaccess.problem.system import System
from stages.scope import ScopeMotion, find_motions, prover_of

PIXELS, STEP_MM, FARTHEST_MM = 81, 0.25, 120.0
TANGENT = np.tan(np.radians(48.0))
MOST_BESIDE = 0.06
"""A mark lies at most this share of the picture beside the region, two radii of a drawn ring."""
MIDDLE_DEG = 7.0
"""The hour of a region that is nearer to the middle of the picture says nothing."""
NOT_APART, MOST_NOT_APART, FEW = "not apart", 0.1, 2
"""An opening without a dark region of its own, behind the border or a spur; the share that may be so, and
the number that always may, as a phantom has some twenty openings."""
LEVELS_MM = np.geomspace(2.0, FARTHEST_MM, 60)


class Seen:
    """The depth in mm of every pixel of the round picture of a tip's camera; 0 beyond its border."""

    def __init__(self, lung: Lung, system: System, tip: np.ndarray) -> None:
        radius = system.scope.radius_mm
        aside = min(max(0.7 * radius, system.tubes.outermost.radius_mm + 0.35), 0.9 * radius)
        self.lung, self.axes, self.eye = lung, tip[:3, :3], tip[:3, 3] + aside * tip[:3, 0]
        middle = TANGENT * ((2.0 * np.arange(PIXELS) + 1.0) / PIXELS - 1.0)
        self.right, self.up = np.meshgrid(middle, middle)
        rays = np.stack([self.up, self.right, np.ones_like(self.up)], axis=2) @ self.axes.T
        rays /= np.linalg.norm(rays, axis=2, keepdims=True)
        self.depth_mm = np.zeros((PIXELS, PIXELS))
        going = np.hypot(self.up, self.right) <= TANGENT
        away = 0.0
        while going.any() and away < FARTHEST_MM:
            away += STEP_MM
            held = (lung.labels_at(self.eye + away * rays[going]) & LUMEN) != 0
            going[going] = held
            self.depth_mm[going] = away

    def pixel(self, point: np.ndarray) -> tuple[int, int] | None:
        """Return row and column of a point that the picture shows, None if it does not."""
        up, right, ahead = self.axes.T @ (point - self.eye)
        if ahead <= 0.0 or np.hypot(up, right) >= TANGENT * ahead:
            return None
        row, column = (int((each / (ahead * TANGENT) + 1.0) / 2.0 * PIXELS) for each in (up, right))
        seen = np.linalg.norm(point - self.eye) <= self.depth_mm[row, column] + STEP_MM
        return (row, column) if seen else None

    def deepest(self, beyond: int, without: set[int]) -> tuple[int, int] | None:
        """Return the darkest pixel in which the airway's middle is seen behind the spur of a way on."""
        tree = self.lung.tree
        fork = int(tree.parent_point[beyond])
        held = np.zeros(tree.n_points, dtype=bool)
        for point in range(beyond, tree.n_points):
            of = int(tree.branch_of_point[point])
            held[point] = (of not in without) and (point == beyond or held[tree.parent_point[point]])
        far = tree.distance_from_root_mm - tree.distance_from_root_mm[fork] >= tree.radius_mm[fork]
        shown = [self.pixel(tree.points_lps[point]) for point in np.flatnonzero(held & far)]
        return max((each for each in shown if each), key=lambda at: self.depth_mm[at], default=None)

    def region(self, own: tuple[int, int], others: list[tuple[int, int]]) -> np.ndarray | None:
        """Return the dark region of a pixel, half as bright as where it is parted from others, if it is."""
        for parted in LEVELS_MM[self.depth_mm[own] > LEVELS_MM]:
            regions = ndimage.label(self.depth_mm >= parted, np.ones((3, 3)))[0]
            if not any(regions[other] == regions[own] for other in others):
                break
        else:
            return None
        light = [1.0 / (1.0 + mm**2 / 520.0) for mm in (parted, self.depth_mm[own])]
        level = np.sqrt(520.0 * (2.0 / sum(light) - 1.0))
        regions = ndimage.label(self.depth_mm >= level, np.ones((3, 3)))[0]
        return regions == regions[own]


def looking(motion: ScopeMotion, one: Bifurcation) -> ScopeMotion:
    """Return a motion up to the picture of a bifurcation, with the bend for a look if there is one."""
    states = motion.states[[*range(one.state + 1), one.state]]
    states[-1, 2] = np.radians(one.bend_deg)
    return replace(motion, states=states)


def told_wrongly(lung: Lung, system: System, motion: ScopeMotion, one: Bifurcation) -> Iterator[str]:
    """Yield what is told of the openings of a bifurcation other than where the picture shows them."""
    seen, tree = Seen(lung, system, looking(motion, one).lps_from_tip), lung.tree
    parent = int(tree.branch_parent[one.openings[0].branch])
    children = {each.branch for each in one.openings if each.branch != parent}
    fork = int(tree.parent_point[tree.branch_start[one.openings[0].branch]])
    darkest = []
    for each in one.openings:
        begin = fork + 1 if each.branch == parent else int(tree.branch_start[each.branch])
        without = children if each.branch == parent else set()
        # A branch that parts soon is seen as several regions, and goes on in each of them.
        parts = set(np.flatnonzero(tree.branch_parent == each.branch).tolist()) - without
        ways = [seen.deepest(int(tree.branch_start[part]), set()) for part in parts]
        darkest.append([way for way in (seen.deepest(begin, without), *ways) if way])
    for n, (opening, own) in enumerate(zip(one.openings, darkest, strict=True)):
        others = [each[0] for k, each in enumerate(darkest) if each and k != n]
        regions = [region for way in own if (region := seen.region(way, others)) is not None]
        said = [wrong_place(seen, opening, region) for region in regions] or [NOT_APART]
        yield min(said, key=len)


def wrong_place(seen: Seen, opening: Opening, region: np.ndarray) -> str:
    """Return what is wrong with hour, side and place of an opening seen in a region, "" if nothing."""
    up, right = seen.up[region].mean(), seen.right[region].mean()
    hour = round(np.degrees(np.arctan2(right, up)) / 30.0) % 12 or 12
    aside_deg = np.degrees(np.arctan(np.hypot(up, right)))
    said = f"{opening.words}: seen at {hour} o'clock, {aside_deg:.0f} degrees from the middle"
    off = 6 if opening.hour == 0 else abs((opening.hour - hour + 6) % 12 - 6)
    side = {"on the right": right, "on the left": -right, "at the top": up, "at the bottom": -up}
    near_middle = aside_deg < MIDDLE_DEG or (opening.hour == 0 and aside_deg < 2.0 * MIDDLE_DEG)
    if not near_middle and (off > 1 or side.get(opening.side, 1.0) < -0.02):
        return f"{said}; off by {off} hours"
    at = seen.pixel(np.array(opening.place_lps))
    if at is None or not opening.in_view:
        return f"{said}; not marked"
    beside = ndimage.distance_transform_edt(~region)[at] > MOST_BESIDE * PIXELS
    dark = seen.depth_mm**2 / (seen.depth_mm**2 + 520.0)
    is_light = dark[at] < 0.5 * dark[region].max()
    return f"{said}; marked beside it, on the wall" if beside and is_light else ""


def routes(lung: Lung, system: System, count: int) -> Iterator[tuple[ScopeMotion, np.ndarray]]:
    """Yield motions, as plans have them, to the deepest tips of so many branches, and their branches."""
    motions, tree = find_motions(lung, system.scope, reach_mm=60.0), lung.tree
    prover = prover_of(lung, system.scope)
    order = np.argsort(-motions.states.advance_mm[motions.state], kind="stable")
    ends: list[int] = []
    for tip in order.tolist():
        moving = motions.motion(tip)
        branch = int(tree.branch_of_point[tree.nearest_point(moving.lps_from_tip[:3, 3])])
        if branch in ends or branch == 0:
            continue
        ends.append(branch)
        simple = prover.simplest(moving, max_curvature_per_mm=np.inf, end_bends_rad=system.scope.bends_rad)
        way = [branch]
        while tree.branch_parent[way[0]] >= 0:
            way.insert(0, int(tree.branch_parent[way[0]]))
        yield simple.between(SHOWN_STEP_MM, SHOWN_TURN_RAD), np.array(way)
        if len(ends) == count:
            return


def all_wrong(lung: Lung, count: int) -> list[str]:
    """Return all that is told wrongly on motions to so many branches; every route has a bifurcation."""
    system = la.load_system("ultrathin")
    wrong = []
    for motion, way in routes(lung, system, count):
        found = route_bifurcations(motion, way, lung, system)
        assert [each.openings[0].branch for each in found] == way[1:].tolist()
        wrong += [f"{one.text} {said}" for one in found for said in told_wrongly(lung, system, motion, one)]
    apart = [each for each in wrong if not each.endswith(NOT_APART)]
    assert len(wrong) - len(apart) <= max(MOST_NOT_APART * len(wrong), FEW) < len(apart)
    return [each for each in apart if not each.endswith(" ")]


def test_openings_are_where_the_picture_shows_them(small_lung: Lung) -> None:
    assert all_wrong(small_lung, 3) == []


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(20))
def test_openings_are_where_the_picture_shows_them_in_any_phantom(seed: int) -> None:
    assert all_wrong(build_lung(make_phantom(seed=seed, size="small").images), 2) == []


@pytest.mark.slow
@pytest.mark.data
@pytest.mark.parametrize("patient", ["Patient1", "Patient2"])
def test_openings_are_where_the_picture_shows_them_in_patients(data_dir: Path, patient: str) -> None:
    assert all_wrong(la.load_patient(data_dir / "med-rad" / patient), 8) == []


def test_where_no_state_shows_all_openings_the_tip_is_bent_for_a_look(
    small_lung: Lung, monkeypatch: pytest.MonkeyPatch
) -> None:
    """So much clearness is asked for that the motion itself has it nowhere."""
    monkeypatch.setattr(bifurcations, "LEAST_CLARITY", 0.02)
    system = la.load_system("ultrathin")
    motion, way = next(routes(small_lung, system, 1))
    found = route_bifurcations(motion, way, small_lung, system)
    looked = [one for one in found if one.bend_deg != one.held_bend_deg]
    assert looked
    for one in looked:
        assert f"bend the tip to {abs(one.bend_deg):.0f}° " in one.text
        assert isinstance(prover_of(small_lung, system.scope).prove(looking(motion, one)), float)
