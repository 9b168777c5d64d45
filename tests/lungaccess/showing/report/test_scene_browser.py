"""The 3-D view of made bodies: what is in front is painted in front, and picked where it is."""

from __future__ import annotations

import json
from collections.abc import Iterator
from itertools import permutations
from typing import Any

import numpy as np
import pytest
import trimesh

from lungaccess.showing.report.html import document
from tests.lungaccess.showing.report import browser
from tests.lungaccess.showing.report.made_scene import (
    DISTANCE_MM,
    GROUND,
    SIDE_PX,
    at,
    axes_of,
    body,
    camera,
    drawn,
    ray,
    shown,
    write_page,
)

pytestmark = [
    pytest.mark.slow,
    pytest.mark.browser,
    pytest.mark.skipif(bool(browser.missing()), reason=browser.missing() or "all there"),
]

DIRECTIONS = ((0, -1, 0), (0, 1, 0), (1, 0, 0), (0.4, -0.3, 0.86), (-0.6, -0.5, -0.62))
MIDDLE = SIDE_PX / 2
COMPILE = """const { gl } = made.scene, [name, text] = arguments;
const shader = gl.createShader(name.endsWith("vert") ? gl.VERTEX_SHADER : gl.FRAGMENT_SHADER);
gl.shaderSource(shader, text); gl.compileShader(shader);
return gl.getShaderParameter(shader, gl.COMPILE_STATUS) ? "" : gl.getShaderInfoLog(shader);"""
RED, BLUE, GREEN, YELLOW = "#c03030", "#3030c0", "#30a030", "#d0b020"


@pytest.fixture(scope="module")
def page(tmp_path_factory: Any) -> Iterator[browser.Browser]:
    with browser.Browser(800, 600) as window:
        window.open(write_page(tmp_path_factory.mktemp("made")))
        yield window


def rod(along: np.ndarray, centre: np.ndarray, radius: float) -> trimesh.Trimesh:
    """Return a rod of 80 mm."""
    ends = [centre - 40.0 * along, centre + 40.0 * along]
    return trimesh.creation.cylinder(radius=radius, segment=np.array(ends), sections=48)


def plate(
    depth_mm: float, key: str, colour: str, opacity: float, back: Any = (0.0, -1.0, 0.0)
) -> dict[str, Any]:
    """Return a plate of 60 x 60 x 4 mm across the view; `depth_mm` is that of its front before the middle."""
    mesh = trimesh.creation.box(extents=[60.0, 4.0, 60.0])
    mesh.apply_translation(np.array(back) * (depth_mm - 2.0))
    return body(mesh, key, colour, opacity)


def test_every_program_of_the_graphics_card_compiles(page: browser.Browser) -> None:
    """Each file as it lies there, as a validator reads it, and what puts together none and many layers."""
    texts = json.loads(document.asset(document.GLSL).removeprefix("export const GLSL = ").rstrip(";\n"))
    assert len(texts) == 10 and all("#include" not in text for text in texts.values())
    for name, text in texts.items():
        if not name.endswith(".glsl"):
            assert page.run(COMPILE, name, text) == "", name
    assert page.run(COMPILE, "wrong.frag", texts["layer.frag"].replace("float depth", "float other")) != ""
    for counts in ((0, 0), (1, 0), (3, 2), (16, 0), (16, 16)):
        page.run("made.scene.programs.together(...arguments)", *counts)


@pytest.mark.parametrize("back", DIRECTIONS)
def test_a_needle_before_a_vessel_looks_different_from_one_behind_it(
    page: browser.Browser, back: tuple[float, float, float]
) -> None:
    """As a solid body and as a see-through one, whichever of the two was added first."""
    view = camera(back)
    right, above, forward = axes_of(view)
    vessel = body(rod(right, np.zeros(3), 6.0), "vessel", RED)
    colours = {}
    for name, place in (("before", -20.0 * forward), ("behind", 20.0 * forward)):
        ends = [place - 40.0 * above, place + 40.0 * above]
        colours["solid", name] = at(
            shown(page, [vessel], view, needle=(ends, 3.0, (0.1, 0.1, 0.9))), MIDDLE, MIDDLE
        )
        needle = body(rod(above, place, 3.0), "needle", BLUE)
        both = [shown(page, order, view) for order in ([vessel, needle], [needle, vessel])]
        np.testing.assert_array_equal(*both)
        colours["see-through", name] = at(both[0], MIDDLE, MIDDLE)
    for kind in ("solid", "see-through"):
        before, behind = colours[kind, "before"], colours[kind, "behind"]
        assert np.abs(before - behind).max() > 40, kind
        # Before it the needle is bluer, and behind it the vessel's red lies over it.
        assert before[2] - before[0] > behind[2] - behind[0] + 40, kind
    assert page.messages() == []


def test_nothing_depends_on_the_order_in_which_structures_were_added(page: browser.Browser) -> None:
    rng = np.random.default_rng(3)
    balls = [
        body(trimesh.creation.icosphere(3, radius=18.0).apply_translation(rng.uniform(-14, 14, 3)), *look)
        for look in (("a", RED, 0.3), ("b", BLUE, 0.5), ("c", GREEN, 0.25), ("d", YELLOW, 0.1))
    ]
    view = camera((0.3, -1.0, 0.2))
    first, *others = [
        shown(page, [balls[n] for n in order], view) for order in list(permutations(range(4)))[::5]
    ]
    assert np.ptp(first[..., 0]) > 60
    for other in others:
        np.testing.assert_array_equal(other, first)


def test_plates_are_blended_from_back_to_front(page: browser.Browser) -> None:
    """Against the blending of each layer over those behind it, computed here; two layers of one body, too."""
    looks = [(30.0, RED, 0.4, "a"), (10.0, BLUE, 0.5, "b"), (-10.0, GREEN, 0.3, "c"), (-30.0, RED, 0.4, "a")]
    red = trimesh.util.concatenate(
        [
            trimesh.creation.box([60.0, 4.0, 60.0]).apply_translation([0.0, 2.0 - d, 0.0])
            for d in (30.0, -30.0)
        ]
    )
    surfaces = [body(red, "a", RED, 0.4), plate(10.0, "b", BLUE, 0.5), plate(-10.0, "c", GREEN, 0.3)]
    picture = shown(page, surfaces, camera((0.0, -1.0, 0.0)))
    ground, expected = np.array(GROUND), np.array(GROUND)
    deep = 0.36 * DISTANCE_MM + 48.0
    for before_mm, colour, opacity, _key in reversed(looks):
        lit = 1.05 * np.array([int(colour[n : n + 2], 16) for n in (1, 3, 5)]) / 255.0
        haze = np.clip(0.6 * (deep / 6.0 - before_mm) / deep, 0.0, 0.6)
        expected = opacity * (lit + haze * (ground - lit)) + (1.0 - opacity) * expected
    np.testing.assert_allclose(at(picture, MIDDLE, MIDDLE), 255.0 * expected, atol=2.5)


def test_a_cut_takes_away_what_is_before_it(page: browser.Browser) -> None:
    view = camera((0.0, -1.0, 0.0))
    ball = body(trimesh.creation.icosphere(4, radius=20.0), "ball", RED)
    whole = shown(page, [ball], view)
    ground = 255.0 * np.array(GROUND)
    picked = {}
    for offset in (-25.0, -8.0, 0.0, 8.0, 25.0):
        plane = {"point": [0.0, offset, 0.0], "normal": [0.0, 1.0, 0.0]}
        page.run("made.scene.setCut(arguments[0])", plane)
        picture = drawn(page, view)
        picked[offset] = page.run("return made.scene.pick(150.5, 150.5)")
        if offset == 25.0:
            np.testing.assert_allclose(at(picture, MIDDLE, MIDDLE), ground, atol=1.0)
    page.run("made.scene.setCut(null)")
    np.testing.assert_array_equal(drawn(page, view), whole)
    # A cut before the ball leaves its front; one through it opens it, and one behind it leaves nothing.
    assert picked[-25.0]["point"][1] == pytest.approx(-20.0, abs=0.2)
    for offset in (-8.0, 0.0, 8.0):
        assert picked[offset]["point"][1] == pytest.approx(20.0, abs=0.2)
    assert picked[25.0] is None


def test_picking_finds_the_point_within_half_a_millimetre(page: browser.Browser) -> None:
    """Of balls, against the intersection of the ray with them, computed here, from several sides."""
    rng = np.random.default_rng(5)
    centres, radii = rng.uniform(-18, 18, (3, 3)), (16.0, 11.0, 8.0)
    surfaces = [
        body(trimesh.creation.icosphere(5, radius=r).apply_translation(c), key, RED, opacity)
        for key, c, r, opacity in zip("abc", centres, radii, (0.4, 0.3, 0.1), strict=True)
    ]
    errors = []
    for back in DIRECTIONS:
        view = camera(back)
        shown(page, surfaces, view)
        for x, y in np.round(rng.uniform(100, 200, (40, 2))) + 0.25:
            found = page.run("return made.scene.pick(arguments[0], arguments[1])", float(x), float(y))
            eye, direction = np.array(view["eye"]), ray(view, x, y)
            hits = {}
            for key, centre, radius in zip("abc", centres, radii, strict=True):
                along = direction @ (centre - eye)
                away = np.linalg.norm(centre - eye - along * direction)
                if away < 0.97 * radius:
                    hits[key] = eye + (along - np.sqrt(radius**2 - away**2)) * direction
                elif away < 1.03 * radius:
                    break
            else:
                if not hits:
                    assert found is None
                    continue
                assert {each["key"] for each in found["hits"]} == set(hits)
                for each in found["hits"]:
                    errors.append(np.linalg.norm(np.array(each["point"]) - hits[each["key"]]))
                # By rule the nearest that is not faint, else the nearest of all.
                dense = {key: hits[key] for key in hits if key != "c"} or hits
                nearest = min(dense, key=lambda key: float(np.linalg.norm(dense[key] - eye)))
                assert found["key"] == nearest
    assert len(errors) > 60
    assert max(errors) < 0.5


def test_solid_bodies_hide_surfaces_from_picking_and_have_names(page: browser.Browser) -> None:
    ball = body(trimesh.creation.icosphere(4, radius=10.0).apply_translation([0.0, 15.0, 0.0]), "ball", RED)
    front = [[-30.0, 0.0, 0.0], [30.0, 0.0, 0.0]]
    shown(page, [ball], camera((0.0, -1.0, 0.0)), needle=(front, 2.0, (0.8, 0.1, 0.4)))
    found = page.run("return made.scene.pick(150.2, 150.2)")
    assert (found["kind"], found["key"], len(found["hits"])) == ("solid", "needle", 1)
    np.testing.assert_allclose(found["point"], [0.0, -2.0, 0.0], atol=0.2)
    assert page.run("return made.scene.pick(150.2, 135)")["key"] == "ball"
    assert page.run("return made.scene.pick(-1, 5)") is None
    behind = [[-30.0, 40.0, 0.0], [30.0, 40.0, 0.0]]
    shown(page, [ball], camera((0.0, -1.0, 0.0)), needle=(behind, 2.0, (0.8, 0.1, 0.4)))
    found = page.run("return made.scene.pick(150.2, 150.2)")
    assert [each["key"] for each in found["hits"]] == ["ball", "needle"]
    listed = page.run("return made.scene.pick(150.2, 150.2, { pickable: [] })")
    assert listed["key"] == "needle"


def test_ten_thousand_points_are_painted_and_picked(page: browser.Browser) -> None:
    rng = np.random.default_rng(7)
    places = rng.uniform(-60, 60, (10_000, 3))
    colours = rng.uniform(0.2, 1.0, places.shape)
    radii = rng.uniform(0.4, 0.9, len(places))
    view = camera((0.0, -1.0, 0.0))
    right, above, forward = axes_of(view)
    shown(page, [], view)
    page.run(
        "made.scene.setPoints('exits', { places: arguments[0], colours: arguments[1], radii: arguments[2] })",
        places.ravel().tolist(), colours.ravel().tolist(), radii.tolist(),
    )  # fmt: skip
    picture = drawn(page, view)
    assert np.ptp(picture, axis=(0, 1)).min() > 60
    away = (places - view["eye"]) @ forward
    across = np.stack([(places - view["eye"]) @ right, -(places - view["eye"]) @ above], axis=1)
    pixels = SIDE_PX / 2 * (1 + across / away[:, None] / np.tan(np.radians(15.0)))
    # Those with nothing before them: no other one within reach of their middle and nearer.
    nearest_first = np.argsort(away)
    open_ones = []
    for n in nearest_first[:400]:
        others = np.linalg.norm(pixels - pixels[n], axis=1)
        if (
            ((others < 8.0) & (away < away[n])).any()
            or not (pixels[n] > 5).all()
            or not (pixels[n] < 295).all()
        ):
            continue
        open_ones.append(n)
    assert len(open_ones) > 40
    for n in open_ones[:40]:
        found = page.run("return made.scene.pick(arguments[0], arguments[1])", *pixels[n].tolist())
        assert (found["kind"], found["key"], found["index"]) == ("points", "exits", n)
        assert np.linalg.norm(np.array(found["point"]) - places[n]) < 1.5
    page.run("made.scene.setPoints('exits', null)")
    assert np.ptp(drawn(page, view), axis=(0, 1)).max() < 1


def test_a_hole_of_names_and_surfaces_leaves_nothing_behind(page: browser.Browser) -> None:
    view = camera((1.0, 0.0, 0.0))
    empty = shown(page, [], view)
    ball = body(trimesh.creation.icosphere(3, radius=20.0), "ball", RED)
    full = shown(page, [ball], view)
    assert np.abs(full - empty).max() > 40
    page.run("made.scene.surfaces.get('ball').shown = false")
    np.testing.assert_array_equal(drawn(page, view), empty)
    page.run("made.scene.surfaces.get('ball').shown = true")
    np.testing.assert_array_equal(drawn(page, view), full)
    assert page.run("return made.scene.gl.getError()") == 0
    assert page.messages() == []
