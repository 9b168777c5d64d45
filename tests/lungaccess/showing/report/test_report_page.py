"""What a page holds, without a browser: nothing is fetched, and the data are those of plan, lung and CT."""

from __future__ import annotations

import html
import re
from dataclasses import replace
from html.parser import HTMLParser
from itertools import pairwise
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

import lungaccess as la
from anatomy.base.words import of_hundred
from anatomy.lung import Lung
from anatomy.structures import VESSEL
from lungaccess.cli.app import main
from lungaccess.cli.exit_code import ExitCode
from lungaccess.judging.appraisal import SHOWN_LIMITS
from lungaccess.plans.curves import arc_lengths
from lungaccess.plans.plan import Plan
from lungaccess.showing.report import pack
from lungaccess.showing.report.html import (
    breathing,
    charts,
    deployment,
    document,
    page_of_no_plan,
    page_of_plan,
    page_of_reach,
    tables,
    words,
)
from lungaccess.showing.report.html.page_of_plan import glance_section
from lungaccess.showing.report.html.page_of_reach import STEPS_PER_MM, packed_map
from tests.lungaccess.showing.report.pages import SIZE_LIMIT, WINDOW, make_reach, reach_file, report_data

NAMESPACE = "http://www.w3.org/2000/svg"
STRUCTURES = {"airway", "vessel", "pleura", "fissure"}
SCRIPTED = {"plan.html": page_of_plan, "no_plan.html": page_of_no_plan, "reach.html": page_of_reach}


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
        html = document.asset(template) + document.scene_figure() + document.slice_controls()
        if page is page_of_plan:
            html += page_of_plan.FOLLOW + breathing.player(WINDOW, True) + breathing.clock_svg(WINDOW, True)
        html += page_of_no_plan.PLACES if page is page_of_no_plan else ""
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
    assert "✗</span> <strong>Refused: do not use:</strong>" in text and "grade-poor" in text
    assert "refused by the independent check (" in text
    assert not elements(written).open
    assert "<" not in pack.script_text({evil: [evil]})


def test_a_hole_without_a_part_is_refused() -> None:
    with pytest.raises(KeyError):
        document.filled("{{here}} {{gone}}", {"here": "{{gone}}"})
    assert document.filled("{{a}}", {"a": "{{b}}"}) == "{{b}}"


# The plan ---------------------------------------------------------------------------------------


def test_the_data_decode_to_the_points_of_the_plans(data: dict[str, Any], plans: tuple[Plan, ...]) -> None:
    assert [each["digest"] for each in data["plans"]] == [each.digest for each in plans]
    for stored, plan in zip(data["plans"], plans, strict=True):
        scope, tip = stored["scope"], plan.scope.lps_from_scope_tip
        for key, end in (("points", tip[:3, 3]), ("forward", tip[:3, 2]), ("up", tip[:3, 0])):
            np.testing.assert_allclose(pack.unpack(scope[key])[-1], end, atol=1e-3)
        body = np.concatenate([pack.unpack(scope["shaft"]), pack.unpack(scope["sections"])[-1]])
        away = np.linalg.norm(plan.curves().scope.points_lps[:, None] - body, axis=2).min(axis=1)
        assert away.max() < 1.0
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
        along, found = profile["arc_length_mm"], profile["clearance_mm"]
        assert set(found) == STRUCTURES
        needle = along > profile["tube_mm"] + 1e-6
        vessel = found["vessel"][needle]
        assert (
            plan.clearance_mm["needle"]["vessel"] - 0.05 <= vessel.min() or vessel.min() >= deployment.CAP_MM
        )
        end = small_lung.exact_clearance_mm(plan.needle.end_lps[None], VESSEL, cap_mm=deployment.CAP_MM)
        assert vessel[-1] == pytest.approx(end[0], abs=1e-3)
        assert (found["airway"][along < profile["exit_mm"] - 0.3] == deployment.NOT_MEASURED).all()
        total = profile["cost"]["inverse_clearance"][-1]
        assert total == pytest.approx(plan.costs["inverse_clearance"], rel=0.02)
        bend = profile["curvature_per_mm"]
        assert bend[-1] == pytest.approx(abs(plan.needle.arcs[-1].curvature_per_mm), rel=1e-5)
        assert bend[needle].max() <= profile["most_curvature_per_mm"] * (1 + 1e-6)


def test_the_camera_follows_the_states_with_the_top_of_its_picture_where_a_bend_turns(
    plans: tuple[Plan, ...],
) -> None:
    from lungaccess.showing.report.html.movie import camera_poses

    tip, poses = plans[0].scope.lps_from_scope_tip, camera_poses(plans[0], 40)
    np.testing.assert_allclose(poses[-1][:3, 2], tip[:3, 2], atol=1e-9)
    np.testing.assert_allclose(-poses[-1][:3, 1], tip[:3, 0], atol=1e-9)
    np.testing.assert_allclose(poses[-1][:3, 3], tip[:3, 3], atol=1e-9)
    rotations = np.array(poses)[:, :3, :3]
    np.testing.assert_allclose(np.linalg.det(rotations), 1.0, atol=1e-9)


def test_cost_over_time_is_read_as_it_was_written(tmp_path: Path) -> None:
    table = tmp_path / "cost.csv"
    table.write_text("elapsed_s,iteration,best\n0.0,0,\n0.5,3,9.5\n1.25,8,7.0\n")
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
    text = page.read_text()
    said = la.appraise(plans[0], small_lung, draws=200)
    header, glance = words.headline(said.headline), glance_section(plans[0], said)
    assert header in text.split("</header>")[0] and words.text(said.headline.reasons) in header
    assert glance in text and text.index(header) < text.index('id="scene"') < text.index(glance)
    tiles = dict(re.findall(r"<span class='what'>(.*?)</span><strong>(.*?)</strong>", glance))
    assert tiles["Chance of success"].endswith(f"{of_hundred(said.headline.success.value)} of 100")
    plan, needle = plans[0], plans[0].needle
    way = plan.scope.length_from_carina_mm + plan.tube.inner_insertion_mm + needle.length_mm
    assert tiles["Length of the way"] == f"{way:.0f} mm"
    assert tiles["Planning time"] == f"{plan.timing['planning_s']:.1f} s"
    assert tiles["Nearest limit"] == f"{said.limits[0].used_words} used"
    for each in said.limits[:SHOWN_LIMITS]:
        row = f'<th scope="row">{words.text(each.what)}</th><td>{each.found_words}</td>'
        assert text.count(row) == 1
    key_numbers = tables.key_section(plans[0], small_lung)
    for each in said.limits:
        assert f">{words.text(each.what)}<" not in key_numbers
    assert "cost map" not in tables.key_section(plans[0], replace(small_lung, cost=None))


def test_every_plan_of_the_page_has_its_chance(data: dict[str, Any]) -> None:
    for each in data["plans"]:
        headline = each["headline"]
        assert headline["geometry"] == "proved and checked"
        assert 0.0 <= headline["success"]["probability"] <= 1.0
        assert headline["draws"] == 200 and headline["errors"]["name"] == "breath-hold"


# Commands ---------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_command_writes_page_and_movie(
    plans: tuple[Plan, ...], small_lung: Lung, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plans[0].save(tmp_path / "plan.json")
    monkeypatch.setattr("lungaccess.cli.options.load_lung", lambda *_: small_lung)
    monkeypatch.setattr(
        "lungaccess.showing.report.html.bronchoscopy_webp", lambda _plan, _lung, path: Path(path).touch()
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


@pytest.mark.slow
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


def test_arc_lengths_add_up() -> None:
    points = np.array([[0.0, 0, 0], [3, 4, 0], [3, 4, 12]])
    assert arc_lengths(points).tolist() == [0.0, 5.0, 17.0]
    assert all(a <= b for a, b in pairwise(arc_lengths(points)))


def test_a_notebook_shows_the_page_in_a_frame(
    small_lung: Lung, plans: tuple[Plan, ...], tmp_path: Path
) -> None:
    shown = la.view(plans[0], small_lung, height_px=500)._repr_html_()
    (page,) = re.findall(r'srcdoc="([^"]*)"', shown)
    written = la.plan_page(plans[0], small_lung, tmp_path / "plan.html").read_text(encoding="utf-8")
    assert len(html.unescape(page)) == pytest.approx(len(written), rel=0.01)
    assert 'sandbox="allow-scripts"' in shown and 'height="500"' in shown


def test_the_colours_of_the_needle_are_those_of_what_the_charts_have_to_spare(
    plans: tuple[Plan, ...], small_lung: Lung
) -> None:
    whole, short = (
        deployment.packed_plan(plans[0], small_lung, "", sections=sections) for sections in (True, False)
    )
    margin, profile = pack.unpack(short["needle"]["margin_mm"]), deployment.profile(plans[0], small_lung)
    limited = [
        v for k, v in profile["clearance_mm"].items() if k != "fissure" or plans[0].fissures_are_obstacles
    ]
    known = (np.min(limited, axis=0) - profile["required_mm"])[-len(margin) :]
    most = deployment.COLOURED_MM
    np.testing.assert_allclose(np.minimum(margin, most), np.minimum(known, most), atol=1e-6)
    assert -1e-3 <= margin.min() < most and f"WIDE_MM = {most:g};" in document.asset("motion.js")
    assert short["needle"] == whole["needle"] and short["scope"].items() <= whole["scope"].items()


def test_charts_show_each_value_in_its_place() -> None:
    line = charts.Line("a & b", "#123456", "", [0.0, 10.0, 20.0, 30.0], [1.0, -1.0, 4.0, 2.0], stairs=True)
    html = charts.line_chart(
        "Title", ("mm", "1/mm"), [line], most=4.0, marks={"exit": 15.0}, cursor="--along-mm"
    )
    svg = ElementTree.fromstring(f"<div>{html}</div>")
    drawn = svg.find("svg/svg/path")
    assert drawn is not None
    # The frame goes from 50 to 506 and from 226 up to 12; below 0 there is a gap, and the last step is down.
    assert drawn.get("d") == "M50.0 172.5M354.0 12.0L506.0 12.0L506.0 119.0"
    assert ["".join(each.itertext()) for each in svg.iterfind("ul/li")] == ["a & b"]
    label = svg.find("svg")
    assert label is not None and label.get("aria-label") == "Title: a & b 1 to 4"
    said = [each.text for each in svg.iter("text")]
    assert said == ["0", "1", "2", "3", "4", "0", "10", "20", "30", "mm", "1/mm", "exit"]
    assert charts.ticks(0.0, 0.026) == pytest.approx([0.0, 0.01, 0.02])
    assert "translateX(calc((var(--along-mm, -1.0) - 0.0) * 15.2px))" in html
