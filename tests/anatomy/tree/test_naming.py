"""Names of bronchi against the truth of phantoms, which are turned, bent, cut and branch in other ways."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from anatomy.airway_tree import AirwayTree
from anatomy.lung import Lung
from anatomy.phantom import Phantom
from anatomy.phantom import plan as planned
from anatomy.phantom.branching import Centerlines, centerlines
from anatomy.phantom.chest import make_chest
from anatomy.phantom.plan import _plan_airways
from anatomy.phantom.territory import make_territory
from anatomy.phantom.traits import Traits
from anatomy.tree import tree_from_graph
from anatomy.tree.naming import DIRECTIONS, LEFT, RIGHT, SEGMENT_LOBES, STEMS, name_bronchi
from tests.anatomy.phantom_lines import edges_of

VARIANTS: tuple[tuple[dict[str, str], tuple[str, ...]], ...] = (
    ({}, ()),
    ({"RB2": "right upper lobe bronchus", "RB3": "right upper lobe bronchus", "RB8": "right basal trunk",
      "RB9+10": "right basal trunk"}, ("RB2+3", "RB8+9+10")),
    ({"RB8+9+10": "right basal trunk"}, ("RB7",)),
    ({"LB1+2": "left upper lobe bronchus", "LB3": "left upper lobe bronchus", "LB9": "left basal trunk",
      "LB10": "left basal trunk", "RB6": "bronchus intermedius"}, ("left upper division", "LB9+10")),
    ({"RB1": "right main bronchus"}, ()),
)  # fmt: skip
"""Other parents of bronchi, and missing bronchi: trifurcations, no RB7, RB6 and RB1 one fork higher."""
FURTHER_JITTER = (0.0, 0.1, 0.16)
"""Standard deviations of the directions of named bronchi beside those of any phantom: up to nine degrees."""


def varied(seed: int, monkeypatch: pytest.MonkeyPatch) -> tuple[AirwayTree, Centerlines]:
    """Return the tree of a phantom of another build, and what was drawn."""
    rng, moved = np.random.default_rng(seed), VARIANTS[seed % len(VARIANTS)]
    kept = (each for each in planned.TEMPLATE if each.name not in moved[1])
    spread = FURTHER_JITTER[seed % len(FURTHER_JITTER)]
    template = tuple(
        each._replace(
            parent=moved[0].get(each.name, each.parent),
            direction=tuple(each.direction + spread * rng.normal(size=3)),
        )
        for each in kept
    )
    monkeypatch.setattr(planned, "TEMPLATE", template)
    traits = Traits(flow_exponent=(2.0, 2.8)[seed % 2], bronchus_length=rng.uniform(0.85, 1.3))
    scale = rng.uniform(0.65, 1.15)
    sprouts, _rule = planned.grow_airways(make_territory(make_chest(rng, scale), rng), scale, rng, traits)
    plan = _plan_airways(sprouts, 1.0)
    named = np.array([bool(name) for name in plan.sprouts.name])
    thick = np.array(plan.sprouts.diameter_mm) >= rng.choice([0.0, 2.2, 3.0])
    keep = named | (thick & (rng.random(len(named)) > 0.03))
    for branch, parent in enumerate(plan.sprouts.parent):
        keep[branch] &= parent < 0 or keep[parent]
    drawn = centerlines(plan.sprouts, plan.inner_mm, plan.outer_mm, keep)
    turned = Rotation.from_rotvec(np.deg2rad(rng.normal(0.0, 5.0, 3))).as_matrix()
    points = drawn.points_lps @ (turned @ (np.eye(3) + rng.normal(0.0, 0.05, (3, 3)))).T
    waves = np.sin(drawn.points_lps @ rng.normal(0.0, 1.0 / 60.0, (3, 3)))
    drawn = replace(drawn, points_lps=points + 3.0 * waves)
    return tree_from_graph(drawn.points_lps, drawn.radius_mm, edges_of(drawn)), drawn


def compared(tree: AirwayTree, drawn: Centerlines) -> Counter[str]:
    """Count segmental bronchi and branches in lobes whose names are right, wrong and missing."""
    names, near, found = tree.bronchi, cKDTree(tree.points_lps), Counter[str]()
    for branch, true in enumerate(drawn.names):
        if true[1:2] == "B" and ("+" not in true or true == "LB1+2"):
            points = drawn.points_lps[drawn.branch_start[branch] : drawn.branch_start[branch + 1]]
            nearest = int(near.query(points[3 * len(points) // 4])[1])
            got = names.names[tree.branch_of_point[nearest]]
            found["segment " + ("right" if got == true else "wrong" if got else "unnamed")] += 1
    ends = tree.points_lps[tree.branch_start[1:] - 1]
    of_point = np.repeat(np.arange(drawn.n_branches), np.diff(drawn.branch_start))
    lobes = drawn.lobe[of_point[cKDTree(drawn.points_lps).query(ends)[1]]]
    for true_lobe, lobe in zip(lobes, names.lobes, strict=True):
        if true_lobe:
            found["lobe " + ("right" if lobe == true_lobe else "wrong" if lobe else "unnamed")] += 1
    return found


def require_good(found: Counter[str]) -> None:
    """Require the shares that names must have."""
    given = found["segment right"] + found["segment wrong"]
    assert found["lobe wrong"] == 0
    assert found["lobe unnamed"] <= 0.05 * found["lobe right"]
    assert found["segment right"] >= 0.95 * given
    assert found["segment unnamed"] <= 0.1 * (given + found["segment unnamed"])


def test_names_of_a_phantom_as_segmented(small_lung: Lung, small_phantom: Phantom) -> None:
    require_good(compared(small_lung.tree, small_phantom.centerlines["airway"]))


def test_names_of_some_phantoms(monkeypatch: pytest.MonkeyPatch) -> None:
    found: Counter[str] = Counter()
    for seed in range(5):
        with monkeypatch.context() as patch:
            found += compared(*varied(seed, patch))
    require_good(found)


@pytest.mark.slow
def test_names_of_many_phantoms(monkeypatch: pytest.MonkeyPatch) -> None:
    found: Counter[str] = Counter()
    for seed in range(100, 124):
        with monkeypatch.context() as patch:
            found += compared(*varied(seed, patch))
    require_good(found)


def test_names_do_not_contradict_each_other(monkeypatch: pytest.MonkeyPatch) -> None:
    """A bronchus begins once, and a segment lies in the lobe that its branch supplies."""
    tree, _drawn = varied(2, monkeypatch)
    named = tree.bronchi
    begun = [name for name, starts in zip(named.names, named.starts, strict=True) if starts]
    assert len(begun) == len(set(begun)) > 25
    for segment, lobe in zip(named.segments, named.lobes, strict=True):
        if segment:
            assert lobe == SEGMENT_LOBES[segment[0]][int(segment[2:].partition("+")[0])]
    assert ((named.confidence >= 0.0) & (named.confidence <= 1.0)).all()


def test_a_turned_tree_is_less_sure(monkeypatch: pytest.MonkeyPatch) -> None:
    """A patient on the side is no patient of the atlas: names are withheld, not invented with confidence."""
    tree, _drawn = varied(0, monkeypatch)
    quarter = Rotation.from_euler("z", 90.0, degrees=True).as_matrix()
    on_side = name_bronchi(replace(tree, points_lps=tree.points_lps @ quarter.T))
    assert on_side.confidence.mean() < tree.bronchi.confidence.mean()


def test_a_bronchus_of_the_trachea_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """The apical bronchus may leave the trachea above the carina, which is then no end of the trachea."""
    _tree, drawn = varied(0, monkeypatch)
    moved = np.zeros(drawn.n_branches, dtype=np.bool_)
    apical = drawn.names.index("RB1")
    moved[apical] = True
    for branch in range(apical + 1, drawn.n_branches):
        moved[branch] = moved[drawn.branch_parent[branch]]
    points = drawn.points_lps.copy()
    of_point = np.repeat(moved, np.diff(drawn.branch_start))
    onto = points[drawn.branch_start[1] * 3 // 4]
    points[of_point] += onto - points[drawn.branch_start[apical]]
    tree = tree_from_graph(points, drawn.radius_mm, edges_of(drawn))
    found = compared(tree, replace(drawn, points_lps=points))
    assert found["segment right"] >= 17
    assert found["segment wrong"] == found["lobe wrong"] == 0


def test_a_tree_of_one_branch_is_a_trachea() -> None:
    points = np.column_stack([np.zeros(20), np.zeros(20), -np.arange(20.0)])
    fork = np.array([[-8.0, 0.0, -25.0], [8.0, 0.0, -25.0]])
    edges = [(n, n + 1) for n in range(19)] + [(19, 20), (19, 21)]
    tree = tree_from_graph(np.vstack([points, fork]), np.full(22, 3.0), edges)
    assert tree.bronchi.names[0] == "trachea"
    assert {tree.bronchi.names[1], tree.bronchi.names[2]} <= {"right main bronchus", "left main bronchus", ""}


@pytest.mark.parametrize("side", [RIGHT, LEFT])
def test_every_stem_divides_into_stems_or_segments(side: str) -> None:
    """The grammar has no dead ends: each set of segments is the union of two smaller ones that it knows."""
    known = {frozenset([n]) for n in DIRECTIONS[side]} | {frozenset(each) for each in STEMS[side]}
    for stem in STEMS[side]:
        parts = [each for each in known if each < frozenset(stem)]
        assert any(frozenset(stem) - each in known for each in parts), stem
