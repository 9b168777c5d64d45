"""Trees of masks with known answers: degenerate, analytic, edited."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from skimage.measure import euler_number

from anatomy.base.errors import AnatomyError
from anatomy.grid import Grid, Volume
from anatomy.tree import tree_from_mask
from tests.anatomy.tubes import CARINA, Tube, Y, edit, outside_mm, tubes


def _volume(array: np.ndarray) -> Volume:
    return Volume(grid=Grid.from_spacing(array.shape, (1, 1, 1), (0, 0, 0)), array=array)


def test_empty_mask_is_refused():
    with pytest.raises(AnatomyError, match="mask is empty"):
        tree_from_mask(_volume(np.zeros((5, 5, 5), bool)))


def test_lungs_as_an_airway_are_refused_before_their_middle_lines_are_looked_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("anatomy.tree.build.thin", pytest.fail)
    grid = Grid.from_spacing((30, 30, 30), (5.0, 5.0, 5.0), (0.0, 0.0, 0.0))
    with pytest.raises(AnatomyError, match=r"has 2744 ml.*at most 1000 ml.*that of the lungs"):
        tree_from_mask(Volume(grid=grid, array=np.pad(np.ones((28, 28, 28), dtype=bool), 1)))


def test_single_voxel_is_refused():
    array = np.zeros((5, 5, 5), bool)
    array[2, 2, 2] = True
    with pytest.raises(AnatomyError, match="No trachea was found"):
        tree_from_mask(_volume(array))


def test_full_image_is_refused():
    with pytest.raises(AnatomyError, match="No trachea was found"):
        tree_from_mask(_volume(np.ones((12, 12, 12), bool)))


@pytest.mark.parametrize(
    "parts",
    [
        pytest.param([((0, 0, 0), (0, 0, 0.1), 15.0)], id="sphere"),
        pytest.param([((0, 0, 0), (0, 0, 90), 8.0)], id="tube that does not divide"),
        pytest.param(
            [((0, 0, 20), (0, 0, 0), 1.8), ((0, 0, 0), (9, 0, -9), 1.4), ((0, 0, 0), (-9, 0, -9), 1.4)],
            id="peripheral bronchi",
        ),
        pytest.param(
            [((0, 0, 12), (0, 0, 0), 3), ((0, 0, 0), (14, 0, -12), 2.2), ((0, 0, 0), (-14, 0, -12), 2.2)],
            id="segmental bronchi",
        ),
        pytest.param(
            [((0, 0, 60), (0, 0, 0), 3), ((0, 0, 0), (30, 0, -30), 9), ((0, 0, 0), (-30, 0, -30), 9)],
            id="wider below than above",
        ),
        pytest.param(
            [((-90, 0, 0), (0, 0, 0), 8), ((0, 0, 0), (40, 30, 0), 6), ((0, 0, 0), (40, -30, 0), 6)],
            id="lying",
        ),
        pytest.param(
            [((0, 0, 60), (0, 0, 0), 3), ((0, 0, 0), (9, 0, -9), 2), ((0, 0, 0), (-90, 0, -90), 2.5)],
            id="vessel with a twig",
        ),
    ],
)
def test_mask_without_trachea_is_refused(parts: list[Tube]):
    with pytest.raises(AnatomyError, match="No trachea was found"):
        tree_from_mask(tubes(parts))


def test_upside_down_mask_is_refused():
    lumen = tubes(Y)
    with pytest.raises(AnatomyError, match="upside down"):
        tree_from_mask(Volume(grid=lumen.grid, array=lumen.array[:, ::-1, ::-1]))


@pytest.mark.parametrize("spacing_mm", [(1.0, 1.0, 1.0), (0.7, 0.7, 1.25), (0.6, 0.9, 0.5)])
def test_y_of_cylinders(spacing_mm: tuple[float, float, float]):
    lumen = tubes(Y, spacing_mm)
    tree = tree_from_mask(lumen)
    assert tree.n_branches == 3
    assert tree.generation.tolist() == [0, 1, 1]
    assert tree.branch_parent.tolist() == [-1, 0, 0]
    assert np.linalg.norm(tree.carina_lps - CARINA) < 3.0
    assert outside_mm(tree, lumen) == 0.0
    voxel = float(np.linalg.norm(spacing_mm))
    truth = [(8.0, (0, 0, -1)), (6.0, (1, 0, -1)), (6.5, (-25, 0, -40))]
    left = 1 if tree.points_lps[tree.branch_points(1)[-1], 0] > 0 else 2
    for branch, (radius, direction) in zip((0, left, 3 - left), truth, strict=True):
        middle = tree.branch_points(branch)
        middle = middle[len(middle) // 3 : 2 * len(middle) // 3]
        assert (tree.radius_mm[middle] <= radius + voxel / 2).all()
        assert (tree.radius_mm[middle] >= radius - voxel).all()
        unit = np.array(direction) / np.linalg.norm(direction)
        assert np.degrees(np.arccos(np.clip(tree.tangents[middle] @ unit, -1, 1))).max() < 8.0
    ends = tree.points_lps[tree.branch_start[1:] - 1]
    assert np.linalg.norm(ends[left] - (40, 0, -40)) < 6.0 + 2 * voxel
    assert abs(tree.branch_length_mm[left] - np.hypot(40, 40)) < 6.0 + 2 * voxel


@pytest.mark.parametrize("clip_top", [False, True])
def test_root_is_inside_the_trachea_with_and_without_a_cut_top(clip_top: bool):
    lumen = tubes(Y)
    if clip_top:
        top = int(lumen.grid.ijk((0, 0, 70.0))[2])
        grid = lumen.grid.crop((0, 0, 0), (*lumen.grid.shape[:2], top))
        lumen = Volume(grid=grid, array=lumen.array[:, :, :top])
    tree = tree_from_mask(lumen)
    assert tree.points_lps[0, 2] > 60.0 - 8.0
    assert np.hypot(*tree.points_lps[0, :2]) < 2.5
    assert tree.radius_mm[0] > 0.75 * 8.0
    assert tree.tangents[0, 2] < -0.9


def test_oblique_grid_gives_the_same_tree():
    lumen = tubes(Y)
    upright = tree_from_mask(lumen)
    angle = 0.3
    turn = np.eye(4)
    turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    turned = Volume(
        grid=Grid(shape=lumen.grid.shape, lps_from_ijk=turn @ lumen.grid.lps_from_ijk), array=lumen.array
    )
    tree = tree_from_mask(turned)
    np.testing.assert_allclose(tree.points_lps, upright.points_lps @ turn[:3, :3].T, atol=1e-6)
    np.testing.assert_allclose(tree.tangents, upright.tangents @ turn[:3, :3].T, atol=1e-6)
    np.testing.assert_allclose(tree.radius_mm, upright.radius_mm, atol=1e-6)


def test_same_mask_gives_the_same_bytes():
    lumen = tubes(Y)
    a, b = tree_from_mask(lumen), tree_from_mask(lumen)
    for name in ("points_lps", "radius_mm", "tangents", "parent_point", "branch_start"):
        assert getattr(a, name).tobytes() == getattr(b, name).tobytes()


def test_bump_on_the_wall_is_pruned_and_reported():
    bump: Tube = ((5.0, 0.0, 40.0), (10.0, 0.0, 40.0), 0.9)
    tree = tree_from_mask(tubes([*Y, bump]))
    assert tree.n_branches == 3
    (spur,) = tree.report.spurs_pruned
    assert np.linalg.norm(spur.position_lps - (10.5, 0, 40)) < 1.5
    # From the centreline, whose voxels lie up to one beside the axis.
    assert 7.5 < spur.length_mm < 12.0


def test_real_side_branch_is_kept_and_does_not_end_the_trachea():
    side: Tube = ((0.0, 0.0, 40.0), (25.0, 0.0, 40.0), 2.0)
    tree = tree_from_mask(tubes([*Y, side]))
    assert tree.n_branches == 4
    assert np.linalg.norm(tree.carina_lps - CARINA) < 3.0
    assert tree.generation.tolist() == [0, 1, 1, 1]
    hooks = tree.points_lps[tree.parent_point[tree.branch_start[1:-1]]]
    assert np.abs(hooks[:, 2] - 40.0).min() < 3.0


def test_a_bulge_of_the_trachea_is_no_main_bronchus():
    """As where the back wall of a trachea is pressed in: a dead end as wide as a bronchus, but short."""
    bulge = ((0.0, 0.0, 60.0), (0.0, 16.0, 50.0), 6.0)
    tree = tree_from_mask(tubes([*Y, bulge]))
    assert np.linalg.norm(tree.carina_lps) < 6.0
    assert tree.n_branches == 4 and np.bincount(tree.generation).tolist() == [1, 3]


@pytest.mark.parametrize("gap_mm", [2.0, 4.0])
def test_short_gap_is_bridged_and_reported(gap_mm: float):
    parts = [Y[0], Y[1], (CARINA, (-25.0, 0.0, -25.0), 6.5), ((-25, 0, -25), (-25, 0, -70), 5.0)]
    whole = tubes(parts)
    broken = edit(whole, (-60, -60, -50.0), (0, 60, -50.0 + gap_mm - 1.0), value=False)
    tree = tree_from_mask(broken)
    (gap,) = tree.report.gaps_bridged
    assert gap.length_mm == pytest.approx(gap_mm, abs=1e-6)
    assert np.linalg.norm(gap.position_lps - (-25, 0, -50 + (gap_mm - 1) / 2)) < 2.0
    assert gap.voxels_joined > 500
    assert tree.report.components_dropped == 0
    assert tree.n_branches == tree_from_mask(whole).n_branches == 3
    assert outside_mm(tree, broken) == pytest.approx(gap_mm, abs=0.6)
    beyond = tree.points_lps[:, 2] < -52.0
    assert beyond.any()
    across = np.abs(tree.points_lps[:, 2] - gap.position_lps[2]) < gap_mm / 2 - 0.51
    across &= tree.points_lps[:, 0] < 0
    assert (tree.radius_mm[across] == 0).all()


def test_long_gap_is_not_bridged():
    parts = [Y[0], Y[1], (CARINA, (-25.0, 0.0, -25.0), 6.5), ((-25, 0, -25), (-25, 0, -70), 5.0)]
    broken = edit(tubes(parts), (-60, -60, -55.0), (0, 60, -48.0), value=False)
    tree = tree_from_mask(broken)
    assert tree.report.gaps_bridged == ()
    assert tree.report.components_dropped == 1
    assert tree.report.voxels_dropped > 500
    assert tree.points_lps[tree.points_lps[:, 0] < -10, 2].min() > -48.0


def test_piece_beside_the_airway_is_not_joined():
    beside: Tube = ((12.0, 0.0, 30.0), (12.0, 0.0, 60.0), 1.5)
    tree = tree_from_mask(tubes([*Y, beside]))
    assert tree.report.gaps_bridged == ()
    assert tree.report.components_dropped == 1
    assert tree.n_branches == 3


def test_voxels_that_touch_by_an_edge_are_reported():
    lumen = tubes(Y, margin_mm=16.0)
    array = lumen.array.copy(order="F")
    i, j, _ = np.rint(lumen.grid.ijk((40, 0, -40))).astype(int)
    lowest = np.flatnonzero(array[i, j])[0]
    for step in range(1, 12):
        array[i + step, j, lowest - step] = True
    lumen = Volume(grid=lumen.grid, array=array)
    tree = tree_from_mask(lumen)
    contacts = [g for g in tree.report.gaps_bridged if g.length_mm == 0.0]
    assert len(contacts) >= 8
    assert tree.n_branches == 3


def test_cavity_is_counted_and_avoided():
    lumen = tubes(Y)
    holed = edit(lumen, (-1, -1, 30), (1, 1, 34), value=False)
    tree = tree_from_mask(holed)
    assert tree.report.cavity_voxels == int(lumen.array.sum()) - int(holed.array.sum()) > 0
    assert outside_mm(tree, holed) == 0.0
    assert tree.n_branches == 3


def test_ring_is_opened_and_reported():
    arc = [(40, 0, -40), (40, 0, -70), (0, 0, -80), (-25, 0, -70), (-25, 0, -40)]
    ring = [(a, b, 3.0) for a, b in zip(arc[:-1], arc[1:], strict=True)]
    lumen = tubes([*Y, *ring])
    thin = edit(lumen, (0, -60, -100), (2, -1, -50), value=False)
    thin = edit(thin, (0, 1, -100), (2, 60, -50), value=False)
    tree = tree_from_mask(thin)
    (loop,) = tree.report.loops_opened
    assert np.linalg.norm(loop.position_lps - (1, 0, -80)) < 5.0
    assert loop.length_mm == pytest.approx(250, abs=40)
    assert outside_mm(tree, thin) == 0.0


def test_trifurcation_is_one_branching():
    parts: list[Tube] = [
        *Y,
        ((40, 0, -40), (80, 0, -40), 4.0),
        ((40, 0, -40), (40, 0, -80), 4.0),
        ((40, 0, -40), (60, 40, -60), 4.0),
    ]
    tree = tree_from_mask(tubes(parts))
    assert tree.n_branches == 6
    assert tree.generation.tolist() == [0, 1, 1, 2, 2, 2]


def test_child_sized_airway_is_accepted_with_a_warning():
    parts: list[Tube] = [
        ((0, 0, 40), (0, 0, 0), 3.0),
        ((0, 0, 0), (18, 0, -18), 2.2),
        ((0, 0, 0), (-12, 0, -16), 2.3),
    ]
    tree = tree_from_mask(tubes(parts, (0.5, 0.5, 0.5)))
    assert tree.n_branches == 3
    assert any("radius" in w for w in tree.report.warnings)


def test_mirrored_airway_is_warned_about():
    parts: list[Tube] = [
        *Y[:2],
        (CARINA, (-15.0, 0.0, -24.0), 6.5),
        ((-15, 0, -24), (-45, 0, -24), 4.0),
        ((-15, 0, -24), (-20, 0, -75), 4.5),
        ((40, 0, -40), (70, 0, -40), 4.0),
        ((40, 0, -40), (40, 0, -75), 4.0),
    ]
    lumen = tubes(parts)
    assert not any("mirrored" in w for w in tree_from_mask(lumen).report.warnings)
    flipped = Volume(grid=lumen.grid, array=lumen.array[::-1])
    assert any("mirrored" in w for w in tree_from_mask(flipped).report.warnings)


@st.composite
def _random_airways(draw: st.DrawFn) -> tuple[list[Tube], int]:
    """Airways of 2 to 4 generations whose branches part widely and never touch again."""
    levels = draw(st.integers(1, 3))
    turn = draw(st.floats(0.0, np.pi))
    tilt = draw(st.floats(0.55, 0.75))
    shrink = draw(st.floats(0.55, 0.62))
    parts: list[Tube] = [((0, 0, 90), (0, 0, 0), 8.0)]
    tips = [(np.zeros(3), np.array([0.0, 0.0, -1.0]), 8.0, 62.0)]
    for level in range(levels):
        grown = []
        for at, way, radius, length in tips:
            side = np.cross(way, (np.sin(turn), np.cos(turn), 0.35) if level else (0.0, 1.0, 0.0))
            side /= np.linalg.norm(side)
            for sign in (-1, 1):
                onwards = np.cos(tilt) * way + sign * np.sin(tilt) * side
                tip = at + length * onwards
                parts.append((at, tip, radius * 0.7))
                grown.append((tip, onwards, radius * 0.7, length * shrink))
        turn += np.pi / 2
        tips = grown
    return parts, levels


@settings(max_examples=10)
@given(_random_airways())
def test_random_tree_is_recovered(case: tuple[list[Tube], int]):
    parts, levels = case
    lumen = tubes(parts, (1.0, 1.0, 1.0))
    # Two tubes that part may touch once more at a corner of voxels: then the mask does have a loop.
    assume(euler_number(lumen.array, connectivity=3) == 1)
    tree = tree_from_mask(lumen)
    assert outside_mm(tree, lumen) == 0.0
    assert (tree.radius_mm > 0).all()
    assert tree.report.loops_opened == ()
    assert len(tree.leaf_branches) == 2**levels
    assert tree.generation.tolist() == sum(([g] * 2**g for g in range(levels + 1)), [])
