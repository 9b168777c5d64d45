"""Traits of phantoms do what they say, and the default ones change nothing."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import edt
import numpy as np
import pytest

from anatomy.base.errors import SettingsError
from anatomy.base.typed import Array, Float
from anatomy.phantom import LABELS, Phantom, make_phantom
from anatomy.phantom.branching import Sprouts
from anatomy.phantom.chest import Chest, Side, make_chest
from anatomy.phantom.plan import CENTRAL, TEMPLATE, ends_below_pleura
from anatomy.phantom.rasterize import draw_body, phantom_grid
from anatomy.phantom.territory import Territory
from anatomy.phantom.traits import PLAIN, Traits

SPACING_MM, RIM_MM, HILAR_MM = 1.75, 8.0, 9.0
SCALE = 0.7


def depth_mm(mask: Array) -> Array:
    """Return the distance to the border of a mask, mm."""
    inside = np.array(mask, dtype=np.bool_, order="F")
    return np.asarray(edt.edt(inside, anisotropy=(SPACING_MM,) * 3, order="F"))


def small(traits: Traits = PLAIN) -> Phantom:
    return make_phantom(seed=1, size="small", spacing_mm=SPACING_MM, traits=traits)


@pytest.fixture(scope="module")
def plain() -> Phantom:
    return small()


@pytest.mark.parametrize(
    "wrong",
    [
        {"bronchus_length": 0.5}, {"bronchus_length": 2.0}, {"bronchus_length": float("nan")},
        {"vessel_rim_mm": -1.0}, {"vessel_rim_mm": 11.0},
        {"hilar_vessel_mm": -1.0}, {"hilar_vessel_mm": 26.0},
    ],
)  # fmt: skip
def test_traits_out_of_their_range_are_refused(wrong: dict[str, Any]) -> None:
    (name,) = wrong
    with pytest.raises(SettingsError, match=f"{name}.*Expected"):
        Traits(**wrong)


def test_each_default_trait_changes_no_bit(plain: Phantom) -> None:
    same = small(Traits(bronchus_length=1.0, vessel_rim_mm=0.0, hilar_vessel_mm=0.0))
    assert same.labels.array.tobytes("F") == plain.labels.array.tobytes("F")
    assert same.images.sources == plain.images.sources
    assert (plain.images.vessels.array == plain.mask("artery", "vein")).all()
    for kind, lines in plain.centerlines.items():
        assert lines.points_lps.tobytes() == same.centerlines[kind].points_lps.tobytes()


def test_main_and_lobar_bronchi_are_longer_and_no_others(plain: Phantom) -> None:
    factor = 1.25
    longer = small(replace(PLAIN, bronchus_length=factor))
    ratios = {}
    for name in ("trachea", *(bronchus.name for bronchus in TEMPLATE)):
        chords = []
        for phantom in (plain, longer):
            lines = phantom.centerlines["airway"]
            if name not in lines.names:
                break
            branch = lines.names.index(name)
            first, last = lines.branch_start[branch], lines.branch_start[branch + 1] - 1
            chords.append(float(np.linalg.norm(lines.points_lps[last] - lines.points_lps[first])))
        else:
            ratios[name] = chords[1] / chords[0]
    assert [ratios[name] for name in CENTRAL] == pytest.approx([factor] * len(CENTRAL), rel=1e-6)
    others = {"trachea", *(b.name for b in TEMPLATE if not b.segment)} - set(CENTRAL)
    found = [ratio for name, ratio in ratios.items() if name in others]
    assert len(found) > len(CENTRAL) and found == pytest.approx([1.0] * len(found), rel=1e-6)


def _box(depth_mm: float) -> Territory:
    """Tissue below a flat pleura at z = 0, over a whole map of 1 mm voxels."""
    down = np.arange(-5.0, depth_mm)
    lobes = np.broadcast_to(down > 0.0, (21, 21, len(down))).astype(np.uint8)
    return Territory(
        origin=np.array([-10.0, -10.0, -5.0]), spacing_mm=1.0, lobes=lobes,
        lobe_depth_mm=edt.edt(np.ascontiguousarray(lobes)).astype(np.float32),
        pleura_depth_mm=np.broadcast_to(np.maximum(down, 0.0), lobes.shape).astype(np.float32),
        points_lps=np.zeros((0, 3)), lobe_of_point=np.zeros(0, dtype=np.uint8),
    )  # fmt: skip


def _line(*depths: float) -> Float:
    return np.array([[0.0, 0.0, depth] for depth in depths])


def test_vessels_end_where_they_run_into_the_rim() -> None:
    """The root begins in the rim and leaves it; its child runs back, the grandchild with it."""
    tree = Sprouts()
    tree.add(-1, _line(2.0, 6.0, 12.0), 4.0, 1)
    tree.add(0, _line(12.0, 9.0, 6.5, 3.0, 1.0), 3.0, 1)
    tree.add(1, _line(1.0, 0.5), 2.0, 1)
    tree.add(0, _line(12.0, 4.0, 2.0), 2.0, 1)
    cut, radius, kept = ends_below_pleura(tree, np.arange(13.0), np.zeros(4, np.uint8), _box(30.0), 5.0)
    # The map is half a voxel deeper than the pleura: 6.5 mm count as 6, 2 mm as 1.5.
    assert kept.tolist() == [True, True, False, False]
    assert [line[:, 2].tolist() for line in cut.points] == [[2.0, 6.0, 12.0], [12.0, 9.0, 6.5]]
    assert radius.tolist() == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]
    named = np.array([0, 1, 0, 0], np.uint8)
    assert ends_below_pleura(tree, np.arange(13.0), named, _box(30.0), 5.0)[2].tolist() == [
        True,
        True,
        False,
        False,
    ]


def _ends_in_the_rim(phantom: Phantom) -> int:
    """Count the vessels that end nearer to the pleura than the rim is deep."""
    depth = depth_mm(phantom.images.lung.array)
    count = 0
    for kind in ("artery", "vein"):
        lines = phantom.centerlines[kind]
        ends = np.setdiff1d(np.arange(1, lines.n_branches), lines.branch_parent)
        ijk = np.rint(phantom.grid.ijk(lines.points_lps[lines.branch_start[ends + 1] - 1])).astype(int)
        count += int((depth[tuple(ijk.T)] < SCALE * RIM_MM).sum())
    return count


@pytest.mark.slow
def test_fewer_vessels_end_in_the_rim(plain: Phantom) -> None:
    """Some are left at the mediastinum, where they have not left the rim yet."""
    rimmed = small(replace(PLAIN, vessel_rim_mm=RIM_MM))
    assert _ends_in_the_rim(rimmed) <= 0.5 * _ends_in_the_rim(plain)
    assert (rimmed.images.lung.array == plain.images.lung.array).all()


def test_wide_vessels_and_those_outside_the_lungs_are_in_neither_mask(plain: Phantom) -> None:
    bare = small(replace(PLAIN, hilar_vessel_mm=HILAR_MM))
    assert bare.labels.array.tobytes("F") == plain.labels.array.tobytes("F"), "only the masks differ"
    vessels, lung = np.asarray(bare.images.vessels.array), np.asarray(bare.images.lung.array)
    assert not (vessels & ~lung).any()
    taken = np.asarray(plain.images.lung.array) & ~lung
    assert taken.any() and (plain.mask("artery", "vein") | ~taken).all()
    assert 2.0 * depth_mm(vessels).max() < SCALE * HILAR_MM + 2.0 * SPACING_MM
    lost = np.asarray(plain.images.vessels.array) & np.asarray(plain.images.lung.array) & ~vessels
    assert (lost == taken).all(), "what leaves the mask of the vessels leaves that of the lungs"


def _body(precise: bool) -> tuple[Array, Array]:
    chest = make_chest(np.random.default_rng(5), SCALE)
    canvas = draw_body(chest, phantom_grid(chest, 1.25), precise=precise)
    return canvas.labels, canvas.lobes


@pytest.mark.parametrize("precise", [True, False])
def test_the_last_digit_decides_no_voxel_of_a_precise_body(
    precise: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Processors differ in the last digit of powers and exponentials."""
    before = _body(precise)
    lung, lobe = Chest.lung, Chest.lobe

    def nudged(z: Array) -> Array:
        return np.asarray(z + 1000.0 * np.finfo(z.dtype).eps)

    def other_lung(chest: Chest, side: Side, x: Array, y: Array, z: Array) -> Array:
        return lung(chest, side, x, y, nudged(z))

    def other_lobe(chest: Chest, side: Side, x: Array, y: Array, z: Array) -> Array:
        return lobe(chest, side, x, y, nudged(z))

    monkeypatch.setattr(Chest, "lung", other_lung)
    monkeypatch.setattr(Chest, "lobe", other_lobe)
    after = _body(precise)
    same = all((a == b).all() for a, b in zip(before, after, strict=True))
    assert same == precise
    assert LABELS["lung"] in before[0]
