"""What a page holds, without a browser: nothing is fetched, and the data are those of plan, lung and CT."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from itertools import combinations, pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

import lungaccess as la
from anatomy.errors import AnatomyError
from anatomy.grid import Grid, Volume
from anatomy.lung import Lung
from anatomy.structures import VESSEL
from lungaccess.appraisal import SHOWN_LIMITS
from lungaccess.cli.app import main
from lungaccess.cli.exit_code import ExitCode
from lungaccess.plans.curves import arc_lengths
from lungaccess.plans.plan import Plan
from lungaccess.report import pack
from lungaccess.report.html import (
    deployment,
    document,
    meshes,
    movie,
    page_of_no_plan,
    page_of_plan,
    page_of_reach,
    tables,
    volumes,
    words,
)
from lungaccess.report.html.page_of_reach import STEPS_PER_MM, packed_map
from tests.lungaccess.report.pages import SIZE_LIMIT, make_plans, make_reach, plan_file, reach_file

NAMESPACE = "http://www.w3.org/2000/svg"
STRUCTURES = {"airway", "vessel", "pleura", "fissure"}
SCRIPTED = {"plan.html": page_of_plan, "no_plan.html": page_of_no_plan, "reach.html": page_of_reach}


@pytest.fixture(scope="module")
def plans(small_lung: Lung) -> tuple[Plan, ...]:
    return make_plans(small_lung)


@pytest.fixture(scope="module")
def page(plans: tuple[Plan, ...], small_lung: Lung, small_phantom: Any, tmp_path_factory: Any) -> Path:
    return plan_file(plans, small_lung, small_phantom.ct, tmp_path_factory.mktemp("page"))


@pytest.fixture(scope="module")
def data(page: Path) -> dict[str, Any]:
    return report_data(page)


def report_data(page: Path) -> dict[str, Any]:
    found = re.search(r'<script type="application/json" id="report-data">(.*?)</script>', page.read_text())
    assert found is not None
    return dict(json.loads(found.group(1)))


class Elements(HTMLParser):
    """Collects elements, and checks that each that is opened is closed in order."""

    VOID = ("meta", "link", "input", "br", "hr", "img")

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.found: list[tuple[str, dict[str, str | None]]] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def elements(page: Path) -> Elements:
    parser = Elements()
    parser.feed(page.read_text())
    return parser


# The file ----------------------------------------------------------------------------------------


def test_a_page_is_complete_in_itself(page: Path) -> None:
    text = page.read_text()
    assert page.stat().st_size < SIZE_LIMIT
    assert set(re.findall(r"https?://[^\s\"'<>]*", text)) == {NAMESPACE}
    assert not re.search(r"\bfetch\(|XMLHttpRequest|\bimport\s*\(|^import |@import|url\(", text, re.MULTILINE)
    parser = elements(page)
    assert not parser.open
    for _tag, attributes in parser.found:
        for name in ("src", "href"):
            assert (attributes.get(name) or "#")[0] == "#" or attributes[name] == "data:,"
    policy = next(a["content"] for _, a in parser.found if a.get("http-equiv") == "Content-Security-Policy")
    assert policy is not None
    assert policy.startswith("default-src 'none';")
    assert "connect-src" not in policy


def test_every_control_has_a_name(page: Path) -> None:
    parser = elements(page)
    tags = [tag for tag, _ in parser.found]
    assert tags.count("h1") == 1 and tags.count("main") == 1 and "header" in tags
    labelled = {a["aria-labelledby"] for tag, a in parser.found if tag == "section"}
    assert labelled <= {a.get("id") for _, a in parser.found}
    for tag, attributes in parser.found:
        if tag == "canvas" or attributes.get("type") == "range":
            assert attributes.get("aria-label")
    ids = [a["id"] for _, a in parser.found if "id" in a]
    assert len(ids) == len(set(ids))


def test_scripts_find_only_elements_that_the_page_has() -> None:
    for template, page in SCRIPTED.items():
        script = document.bundle([*document.SHARED_MODULES, *page.MODULES])
        views = "" if page is page_of_reach else document.TARGET_BUTTON
        html = document.asset(template) + document.scene_figure(more_views=views)
        present = set(re.findall(r'id="([\w-]+)"', html + document.asset("frame.html")))
        wanted = set(re.findall(r'(?:byId|getElementById)\("([\w-]+)"\)', script))
        assert {"scene", "slice-place"} <= wanted <= present


def test_modules_import_what_others_export_and_share_no_name() -> None:
    for page in SCRIPTED.values():
        names = [*document.SHARED_MODULES, *page.MODULES]
        exported: dict[str, set[str]] = {}
        declared: list[str] = []
        for name in names:
            text = document.asset(name)
            for wanted, source in re.findall(r'^import \{ (.*?) \} from "\./(.*?)";$', text, re.MULTILINE):
                assert set(wanted.split(", ")) <= exported[source], (name, source)
            declaration = r"^(export )?(?:async )?(?:function|class|const|let) (\w+)"
            found = re.findall(declaration, text, re.MULTILINE)
            also = re.findall(r"^const \w+ = [^\n]*?, (\w+) = ", text, re.MULTILINE)
            exported[name] = {word for mark, word in found if mark}
            declared += [word for _, word in found] + also
        assert len(declared) == len(set(declared))
        bundled = document.bundle(names)
        assert not re.search(r"^(import|export) ", bundled, re.MULTILINE)


def test_names_cannot_become_markup(plans: tuple[Plan, ...], small_lung: Lung, tmp_path: Path) -> None:
    evil = "</script><script>alert(1)</script>{{limits}}"
    named = replace(plans[0], patient_name=evil)
    options = page_of_plan.PageOptions(risk_samples=0, instructions=False)
    written = page_of_plan.plan_page(named, small_lung, tmp_path / "evil.html", options)
    text = written.read_text()
    assert "<script>alert" not in text
    assert "Refused by the independent check" in text and "grade-poor" in text
    assert not elements(written).open
    assert "<" not in pack.script_text({evil: [evil]})


def test_a_hole_without_a_part_is_refused() -> None:
    with pytest.raises(KeyError):
        document.filled("{{here}} {{gone}}", {"here": "{{gone}}"})
    assert document.filled("{{a}}", {"a": "{{b}}"}) == "{{b}}"


# Numbers as text ---------------------------------------------------------------------------------


@given(st.sampled_from(["u1", "u2", "i4"]), st.lists(st.integers(0, 255), max_size=60), st.booleans())
def test_whole_numbers_survive_packing(kind: str, values: list[int], wide: bool) -> None:
    scale = 257 if wide and kind != "u1" else 1
    array = np.array(values, dtype=np.int64).reshape(1, -1) * scale
    if kind == "i4":
        array = -array
    np.testing.assert_array_equal(pack.unpack(pack.pack(array, kind)), array)


@given(st.lists(st.floats(width=32, allow_nan=False, allow_infinity=False), max_size=40))
def test_single_precision_survives_packing(values: list[float]) -> None:
    np.testing.assert_array_equal(pack.unpack(pack.pack(values, "f4")), np.array(values, dtype=np.float32))


@pytest.mark.parametrize(
    ("values", "kind"), [([np.nan], "f4"), ([1e300], "f4"), ([256], "u1"), ([0.5], "i4")]
)
def test_what_a_type_cannot_hold_is_refused(values: list[float], kind: str) -> None:
    with np.errstate(over="ignore", invalid="ignore"), pytest.raises(AnatomyError):
        pack.pack(values, kind)


# The plan ----------------------------------------------------------------------------------------


def test_the_data_decode_to_the_points_of_the_plans(data: dict[str, Any], plans: tuple[Plan, ...]) -> None:
    assert [each["digest"] for each in data["plans"]] == [each.digest for each in plans]
    for stored, plan in zip(data["plans"], plans, strict=True):
        np.testing.assert_allclose(pack.unpack(stored["scope"]["points"]), plan.scope.points_lps, atol=1e-4)
        tubes, needle = pack.unpack(stored["tubes"]["points"]), pack.unpack(stored["needle"]["points"])
        np.testing.assert_allclose(
            tubes[:, 0], np.tile(plan.scope.lps_from_scope_tip[:3, 3], (len(tubes), 1)), atol=1e-4
        )
        np.testing.assert_allclose(tubes[-1, -1], plan.tube.lps_from_tip[:3, 3], atol=1e-3)
        np.testing.assert_allclose(needle[0], plan.needle.lps_from_start[:3, 3], atol=1e-4)
        np.testing.assert_allclose(needle[-1], plan.needle.end_lps, atol=1e-3)
        assert pack.unpack(stored["needle"]["arc_length_mm"])[-1] == pytest.approx(
            plan.needle.length_mm, abs=1e-4
        )
        assert stored["target_lps"] == plan.target_lps.tolist()
        assert stored["accepted"]


def test_tubes_go_out_together_and_then_the_inner_one_alone(
    data: dict[str, Any], plans: tuple[Plan, ...]
) -> None:
    for stored, plan in zip(data["plans"], plans, strict=True):
        inner, outer = (pack.unpack(stored["tubes"][name]) for name in ("inner_mm", "outer_mm"))
        assert (np.diff(inner) >= 0).all()
        assert (np.diff(outer) >= 0).all()
        assert inner[-1] == pytest.approx(plan.tube.inner_insertion_mm, abs=1e-4)
        assert outer[-1] == pytest.approx(plan.tube.outer_insertion_mm, abs=1e-4)
        alone = inner > outer + 1e-4
        np.testing.assert_allclose(outer[alone], plan.tube.outer_insertion_mm, atol=1e-4)
        points = pack.unpack(stored["tubes"]["points"])
        lengths = np.linalg.norm(np.diff(points, axis=1), axis=2).sum(axis=1)
        np.testing.assert_allclose(lengths, inner, atol=0.02)


def test_the_profile_agrees_with_the_plan_and_with_exact_distances(
    plans: tuple[Plan, ...], small_lung: Lung
) -> None:
    for plan in plans:
        profile = deployment.profile(plan, small_lung)
        along = pack.unpack(profile["arc_length_mm"])
        found = {name: pack.unpack(each) for name, each in profile["clearance_mm"].items()}
        assert set(found) == STRUCTURES
        needle = along > profile["tube_mm"] + 1e-6
        vessel = found["vessel"][needle]
        assert (
            plan.clearance_mm["needle"]["vessel"] - 0.05 <= vessel.min() or vessel.min() >= deployment.CAP_MM
        )
        end = small_lung.exact_clearance_mm(plan.needle.end_lps[None], VESSEL, cap_mm=deployment.CAP_MM)
        assert vessel[-1] == pytest.approx(end[0], abs=1e-3)
        margin = pack.unpack(profile["margin_mm"])
        assert margin.min() >= -1e-3
        assert (found["airway"][along < profile["exit_mm"] - 0.3] == deployment.NOT_MEASURED).all()
        total = pack.unpack(profile["cost"]["inverse_clearance"])[-1]
        assert total == pytest.approx(plan.costs["inverse_clearance"], rel=0.02)
        bend = pack.unpack(profile["curvature_per_mm"])
        assert bend[-1] == pytest.approx(abs(plan.needle.arcs[-1].curvature_per_mm), rel=1e-5)
        assert bend[needle].max() <= profile["most_curvature_per_mm"] * (1 + 1e-6)


def test_the_camera_starts_front_up_and_ends_as_the_tip_points(plans: tuple[Plan, ...]) -> None:
    scope = plans[0].scope
    forward, up = deployment.camera_axes(np.asarray(scope.points_lps), scope.lps_from_scope_tip)
    np.testing.assert_allclose(np.linalg.norm(forward, axis=1), 1.0, atol=1e-9)
    np.testing.assert_allclose((forward * up).sum(axis=1), 0.0, atol=1e-9)
    np.testing.assert_allclose(forward[-1], scope.lps_from_scope_tip[:3, 2], atol=1e-9)
    assert up[0] @ np.array([0.0, -1.0, 0.0]) > 0.9
    turned = np.arccos(np.clip((up[1:] * up[:-1]).sum(axis=1), -1, 1))
    bent = np.arccos(np.clip((forward[1:] * forward[:-1]).sum(axis=1), -1, 1))
    assert (turned <= bent + 1e-6).all()


def test_cost_over_time_is_read_as_it_was_written(tmp_path: Path) -> None:
    table = tmp_path / "cost.csv"
    table.write_text("elapsed_s,iteration,best_cost\n0.0,0,\n0.5,3,9.5\n1.25,8,7.0\n")
    assert page_of_plan.cost_history(table) == [[0.5, 9.5], [1.25, 7.0]]
    assert page_of_plan.cost_history(tmp_path / "none.csv") == []
    assert page_of_plan.cost_history(None) == []


def test_tables_show_each_finding_once(plans: tuple[Plan, ...], small_lung: Lung) -> None:
    report = la.check(plans[0], small_lung)
    html = tables.check_section(report)
    for finding in report.findings:
        assert html.count(f'<th scope="row">{finding.name}</th>') == sum(
            other.name == finding.name for other in report.findings
        )
    refused = la.check(replace(plans[0], lung_key="other"), small_lung)
    assert words.verdict(False) in tables.check_section(refused)


def test_the_page_begins_with_headline_and_limits(
    page: Path, plans: tuple[Plan, ...], small_lung: Lung
) -> None:
    """Each distance has one number: that of the check, at the top; the key numbers repeat none."""
    header = page.read_text().split("</header>")[0]
    said = la.appraise(plans[0], small_lung, draws=200)
    assert words.headline(said.headline) in header
    assert words.text(said.headline.text) in header
    for each in said.limits[:SHOWN_LIMITS]:
        row = f'<th scope="row">{words.text(each.what)}</th><td>{each.found_words}</td>'
        assert row in header
    key_numbers = tables.key_section(plans[0], small_lung)
    for each in said.limits:
        assert f">{words.text(each.what)}<" not in key_numbers
    assert "cost map" not in tables.key_section(plans[0], replace(small_lung, cost=None))


def test_every_plan_of_the_page_has_its_chance(data: dict[str, Any]) -> None:
    for each in data["plans"]:
        headline = each["headline"]
        assert headline["geometry"] == "proved and checked"
        assert 0.0 <= headline["success"]["probability"] <= 1.0
        assert headline["draws"] == 200 and headline["errors"]["name"] == "default"


# Surfaces and volumes ----------------------------------------------------------------------------


def unpacked(packed: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    steps = pack.unpack(packed["vertices"]).astype(float) / meshes.STEPS
    vertices = np.array(packed["low_lps"]) + steps * np.array(packed["size_mm"])
    return vertices, meshes.faces_from_differences(pack.unpack(packed["faces"]))


def test_a_ball_stays_a_ball() -> None:
    grid = Grid.from_spacing((60, 60, 60), [0.5] * 3, [-15.0, -12.0, -9.0])
    centre = grid.lps([30.0, 30.0, 30.0])
    points = grid.lps(np.stack(np.meshgrid(*[np.arange(60)] * 3, indexing="ij"), axis=-1))
    ball = Volume(grid=grid, array=np.linalg.norm(points - centre, axis=-1) <= 10.0)
    look = meshes.Look(
        key="ball", name="Ball", colour="#123456", opacity=0.5, shown=True, cell_mm=1.2, most_faces=3000
    )
    vertices, faces = unpacked(meshes.packed_surface(ball, look))
    assert 300 < len(faces) <= look.most_faces
    radii = np.linalg.norm(vertices - centre, axis=1)
    np.testing.assert_allclose(radii, 10.0, atol=0.6)
    a, b, c = (vertices[faces[:, n]] - centre for n in range(3))
    volume = np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0
    assert volume == pytest.approx(4.0 / 3.0 * np.pi * 1000.0, rel=0.05)


def test_no_surface_has_more_triangles_than_its_look_allows(data: dict[str, Any], small_lung: Lung) -> None:
    looks = {look.key: look for look in meshes.LOOKS}
    assert [each["key"] for each in data["structures"]] == [look.key for look in meshes.LOOKS]
    for packed in data["structures"]:
        vertices, faces = unpacked(packed)
        assert 0 < len(faces) <= looks[packed["key"]].most_faces
        assert faces.min() == 0
        assert faces.max() == len(vertices) - 1
        mask = meshes.structure(small_lung, packed["key"])
        assert mask is not None
        where = mask.grid.lps(np.argwhere(mask.array))
        slack = 2.0 * looks[packed["key"]].cell_mm + 2.0 * float(mask.grid.spacing_mm.max())
        np.testing.assert_allclose(vertices.min(axis=0), where.min(axis=0), atol=slack)
        np.testing.assert_allclose(vertices.max(axis=0), where.max(axis=0), atol=slack)


def voxels(packed: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Return values `[i, j, k]` and LPS centres of a packed volume."""
    array = pack.unpack(packed["voxels"])
    if packed["differences"]:
        array = np.cumsum(array, axis=2, dtype=np.uint8)
    array = array.transpose(2, 1, 0)
    grid = Grid.from_spacing(array.shape, [packed["spacing_mm"]] * 3, packed["first_lps"])
    return array, grid.lps(np.stack(np.meshgrid(*map(np.arange, array.shape), indexing="ij"), axis=-1))


def test_label_volumes_agree_with_the_labels(data: dict[str, Any], small_lung: Lung) -> None:
    codes = volumes.label_codes(small_lung, (0, 0, 0), small_lung.grid.shape)
    rng = np.random.default_rng(0)
    coarse, fine = data["labels"]
    assert fine["spacing_mm"] <= coarse["spacing_mm"]
    for packed in (coarse, fine):
        array, centres = voxels(packed)
        chosen = rng.integers(0, array.size, 4000)
        lps, values = centres.reshape(-1, 3)[chosen], array.reshape(-1)[chosen]
        ijk = small_lung.grid.ijk(lps)
        clear = (np.abs(ijk - np.floor(ijk) - 0.5) > 1e-3).all(axis=1) & small_lung.grid.contains(lps)
        index = np.floor(ijk[clear] + 0.5).astype(int)
        np.testing.assert_array_equal(values[clear], codes.array[tuple(index.T)])
    assert set(np.unique(codes.array)) == set(volumes.CODES.values())


def test_ct_bytes_say_the_hounsfield_units(small_lung: Lung, plans: tuple[Plan, ...]) -> None:
    grid = small_lung.grid
    lps = grid.lps(np.stack(np.meshgrid(*map(np.arange, grid.shape), indexing="ij"), axis=-1))
    slope, middle = np.array([3.0, -2.0, 1.5]), lps.reshape(-1, 3).mean(axis=0)
    ramp = Volume(grid=grid, array=((lps - middle) @ slope - 500.0).astype(np.float32))
    near = deployment.device_points(plans[0])
    for packed in volumes.ct_volumes(ramp, small_lung, near):
        array, centres = voxels(packed)
        inner = tuple(slice(3, -3) for _ in range(3))
        wanted = (centres[inner] - middle) @ slope - 500.0
        found = volumes.LOWEST_HU + volumes.HU_PER_STEP * array[inner].astype(float)
        within = (wanted > -1300) & (wanted < 200)
        assert within.any()
        # Half a step of rounding, and half a voxel where several are averaged to one.
        allowed = 0.5 * volumes.HU_PER_STEP + np.abs(slope) @ grid.spacing_mm
        assert np.abs(found - wanted)[within].max() <= allowed
        assert abs((found - wanted)[within].mean()) <= 0.6 * volumes.HU_PER_STEP


def test_a_ct_of_something_else_is_refused(small_lung: Lung, plans: tuple[Plan, ...]) -> None:
    far = Grid.from_spacing((8, 8, 8), [1.0] * 3, [900.0, 900.0, 900.0])
    ct = Volume(grid=far, array=np.zeros(far.shape, dtype=np.int16))
    with pytest.raises(AnatomyError, match="CT"):
        volumes.ct_volumes(ct, small_lung, deployment.device_points(plans[0]))


def test_a_ct_in_the_patients_folder_is_found(tmp_path: Path) -> None:
    assert volumes.find_ct(tmp_path) is None
    (tmp_path / "ct.nrrd").touch()
    assert volumes.find_ct(tmp_path) == tmp_path / "ct.nrrd"


# Virtual bronchoscopy ----------------------------------------------------------------------------


def test_rays_meet_the_wall_where_the_lumen_ends(small_lung: Lung, plans: tuple[Plan, ...]) -> None:
    scope = plans[0].scope
    lumen = movie.SmoothLumen(small_lung, np.asarray(scope.points_lps))
    n = int(np.argmax(scope.lumen_radius_mm))
    pose = movie.camera_poses(plans[0], len(scope.points_lps))[n]
    angles = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
    rays = np.cos(angles)[:, None] * pose[:3, 0] + np.sin(angles)[:, None] * pose[:3, 1]
    away = lumen.wall_distance(pose[:3, 3], rays)
    voxel = float(small_lung.grid.spacing_mm.max())
    assert away.min() == pytest.approx(scope.lumen_radius_mm[n], abs=1.2 * voxel)
    np.testing.assert_allclose(lumen.share(pose[:3, 3] + away[:, None] * rays), movie.HALF, atol=0.3)
    inwards = lumen.normals(pose[:3, 3] + away[:, None] * rays)
    assert ((inwards * rays).sum(axis=1) < -0.5).all()


def test_the_movie_has_its_pictures(small_lung: Lung, plans: tuple[Plan, ...], tmp_path: Path) -> None:
    path = movie.bronchoscopy_webp(plans[0], small_lung, tmp_path / "fly.webp", frames=3, pixels=48)
    with Image.open(path) as picture:
        assert (picture.format, picture.size, picture.n_frames) == ("WEBP", (48, 48), 3)
        first = np.asarray(picture.convert("RGB"), dtype=float)
        picture.seek(2)
        last = np.asarray(picture.convert("RGB"), dtype=float)
    assert first[24, 40].mean() > 40
    assert first[0, 0].mean() < 30
    assert np.abs(first - last).mean() > 2


# Colours -----------------------------------------------------------------------------------------

# Linear RGB as people without one kind of cone see it [Machado2009, severity 1].
VISIONS = {
    "full": np.eye(3),
    "protanopia": np.array(
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]
    ),
    "deuteranopia": np.array(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
    ),
    "tritanopia": np.array(
        [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]]
    ),
}


def lab(colour: str, vision: np.ndarray) -> np.ndarray:
    """Return CIE L*a*b* of "#rrggbb" as a vision sees it."""
    srgb = np.array([int(colour[n : n + 2], 16) for n in (1, 3, 5)]) / 255.0
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    seen = np.clip(vision @ linear, 0.0, 1.0)
    xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]) @ seen
    f = np.cbrt(np.maximum(xyz / np.array([0.9505, 1.0, 1.089]), 1e-6))
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


COLOURS_TOGETHER = {
    "devices": ("plan.js", ["#0072B2", "#E69F00", "#D81B60"]),
    "clearance of the needle": ("motion.js", ["#D81B60", "#56B4E9"]),
    "devices in slices": ("plan.js", ["#3FA9E8", "#E69F00", "#FF4081"]),
    "charts": ("plan.js", ["#3A9BD5", "#D81B60", "#B8860B", "#785EF0"]),
}


@pytest.mark.parametrize("vision", VISIONS)
def test_colours_are_told_apart_by_every_vision(vision: str) -> None:
    for name, (module, colours) in COLOURS_TOGETHER.items():
        assert all(colour in document.asset(module) for colour in colours), name
        for one, other in combinations(colours, 2):
            gap = np.linalg.norm(lab(one, VISIONS[vision]) - lab(other, VISIONS[vision]))
            assert gap > 20.0, (name, one, other)


def test_text_stands_out_in_light_and_dark() -> None:
    style = document.asset("style.css")
    schemes = [dict(re.findall(r"--(\w+): (#\w{6})", part)) for part in style.split("@media", 2)[:2]]
    assert len(schemes) == 2
    for scheme in schemes:
        for ink in ("ink", "faint", "accent", "good", "fair", "bad"):
            for paper in ("paper", "card"):
                assert contrast(scheme[ink], scheme[paper]) >= 4.5, (ink, paper)


def contrast(one: str, other: str) -> float:
    """Return the contrast of two colours as WCAG 2 defines it."""
    light = []
    for colour in (one, other):
        srgb = np.array([int(colour[n : n + 2], 16) for n in (1, 3, 5)]) / 255.0
        linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
        light.append(float(linear @ [0.2126, 0.7152, 0.0722]))
    return (max(light) + 0.05) / (min(light) + 0.05)


# Commands ----------------------------------------------------------------------------------------


def test_the_command_writes_page_and_movie(
    plans: tuple[Plan, ...], small_lung: Lung, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plans[0].save(tmp_path / "plan.json")
    monkeypatch.setattr("lungaccess.cli.options.load_lung", lambda *_: small_lung)
    monkeypatch.setattr(
        "lungaccess.report.html.bronchoscopy_webp", lambda _plan, _lung, path: Path(path).touch()
    )
    arguments = ["report", str(tmp_path / "plan.json"), str(tmp_path), "--samples", "50", "--no-instructions"]
    assert main([*arguments, "--movie", str(tmp_path / "new" / "fly.webp")]) == ExitCode.OK
    assert (tmp_path / "new" / "fly.webp").exists()
    assert report_data(tmp_path / "report.html")["ct"] is None
    assert "No CT was given" in (tmp_path / "report.html").read_text()


@pytest.mark.parametrize("wrong", [["--alternatives", "-1"], ["--samples", "-5"]])
def test_negative_numbers_are_bad_input(wrong: list[str], tmp_path: Path) -> None:
    assert main(["report", str(tmp_path / "plan.json"), str(tmp_path), *wrong]) == ExitCode.BAD_INPUT


def test_a_plan_that_is_none_is_bad_input(tmp_path: Path) -> None:
    assert main(["report", str(tmp_path / "plan.json"), str(tmp_path)]) == ExitCode.BAD_INPUT


# The reachability map ----------------------------------------------------------------------------


def test_a_map_decodes_to_itself(small_lung: Lung, tmp_path: Path) -> None:
    reach = make_reach(small_lung)
    packed = packed_map(reach)
    np.testing.assert_array_equal(pack.unpack(packed["kind"]).transpose(2, 1, 0), reach.kinds.array)
    stored = pack.unpack(packed["clearance"]).transpose(2, 1, 0) / STEPS_PER_MM
    low = np.minimum(reach.clearance_mm.array, 255 / STEPS_PER_MM)
    np.testing.assert_allclose(stored, low, atol=0.5 / STEPS_PER_MM + 1e-6)
    page = reach_file(reach, small_lung, tmp_path)
    assert page.stat().st_size < SIZE_LIMIT
    assert set(re.findall(r"https?://[^\s\"'<>]*", page.read_text())) <= {NAMESPACE}
    assert not elements(page).open
    for row in reach.by_region():
        assert f'<th scope="row">{row.name}</th><td>{row.volume_ml:.0f}</td>' in page.read_text()


def test_edges_of_the_page_grid_are_those_of_the_lung() -> None:
    grid = Grid.from_spacing((40, 50, 60), [2.0] * 3, [5.0, 6.0, 7.0])
    coarse, fine = volumes.page_grids(grid, np.array([[40.0, 50.0, 60.0]]))
    for made in (coarse, fine):
        low = made.lps(np.full(3, -0.5))
        high = made.lps(np.array(made.shape) - 0.5)
        assert (low >= grid.lps(np.full(3, -0.5)) - 1e-9).all()
        assert (high >= np.array([40.0, 50.0, 60.0])).all()
    np.testing.assert_allclose(coarse.lps(np.full(3, -0.5)), [4.0, 5.0, 6.0])
    assert np.prod(coarse.shape) <= 1.05 * volumes.COARSE_VOXELS


def test_arc_lengths_add_up() -> None:
    points = np.array([[0.0, 0, 0], [3, 4, 0], [3, 4, 12]])
    assert arc_lengths(points).tolist() == [0.0, 5.0, 17.0]
    assert all(a <= b for a, b in pairwise(arc_lengths(points)))


def test_a_lung_without_nodules_and_fissures_has_fewer_surfaces(bare_lung: Any) -> None:
    bare = SimpleNamespace(**{**vars(bare_lung), "nodules": None})
    assert [each["key"] for each in meshes.structure_meshes(bare)] == ["lung", "vessel", "airway"]
