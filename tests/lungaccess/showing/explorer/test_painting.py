"""Masks mended by hand: strokes become voxels, stay with the patient, and every process knows them."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lungaccess as la
from anatomy.io.corrections import corrections_file
from anatomy.structures import LUMEN, VESSEL
from lungaccess.showing.explorer import Explorer, PatientSource
from lungaccess.showing.report.html.volumes import find_ct
from tests.lungaccess.planning.coupled.planning import TARGET
from tests.lungaccess.showing.explorer.client import Client, opened, with_client
from tests.lungaccess.showing.explorer.windows import PLANNED, Page, Served
from tests.lungaccess.showing.report import browser


@pytest.fixture
def painted(patient: Path, tmp_path: Path) -> PatientSource:
    """A patient of which the masks may be corrected, with its own copy of the prepared anatomy."""
    folder = tmp_path / "patient"
    shutil.copytree(patient, folder)
    shutil.copytree(patient.parent / "cache", tmp_path / "cache")
    return PatientSource(folder=folder, system="ultrathin", cache=tmp_path / "cache", ct=find_ct(folder))


def lung_of(source: PatientSource) -> la.Lung:
    return la.load_patient(source.patient, cache=source.cache)


def what_if() -> dict[str, Any]:
    return {"system": "ultrathin"}


def middle(lung: la.Lung, bit: int) -> list[float]:
    """Return the place of a voxel of a structure, away from the border of the grid."""
    voxels = np.argwhere((lung.labels & bit) != 0)
    return [float(value) for value in lung.grid.lps(voxels[len(voxels) // 2])]


def test_a_stroke_is_known_to_all_that_answers_and_can_be_taken_back(painted: PatientSource) -> None:
    before = lung_of(painted)
    text = f"lps:{','.join(f'{value:.1f}' for value in la.resolve_target(before, text=TARGET).lps_mm)}"
    point = [float(value) for value in text[4:].split(",")]

    async def talk(client: Client, _explorer: Explorer) -> None:
        place = (await client.first("place", point=point))[0]
        assert place["tissue"] != "vessel"
        assert (await client.first("paint", tool="open"))[0]["answer"] == "end"
        assert not corrections_file(painted.patient).exists()
        first = (await client.first("plan", target=text, what_if=what_if()))[0]
        assert first["answer"] == "plan"
        found, _ = await client.first(
            "paint", tool="paint", structure="vessel", points=[point], radius_mm=3.0
        )
        assert found["answer"] == "painted"
        assert 0.05 < found["size_ml"] < 0.3
        place = (await client.first("place", point=point))[0]
        assert place["tissue"] == "vessel"
        refused = (await client.first("plan", target=text, what_if=what_if()))[0]
        assert refused["answer"] == "error", "the target now lies in an obstacle"
        forgotten = (await client.first("appraise", plan=first["digest"]))[0]
        assert forgotten["error"]["found"] == "The plan is not known", "it was made for other masks"
        facts = (await client.first("patient"))[0]
        assert any("corrected the masks by hand: vessel" in words for words in facts["warnings"])
        await client.first("paint", tool="undo")
        again = (await client.first("plan", target=text, what_if=what_if()))[0]
        assert again["digest"] == first["digest"]
        nothing = (await client.first("paint", tool="undo"))[0]
        assert nothing["error"]["found"] == "No stroke is left to be taken back"

    with_client(painted, talk)
    assert not corrections_file(painted.patient).exists()


def test_corrections_are_there_when_the_patient_is_opened_again(painted: PatientSource) -> None:
    point = middle(lung_of(painted), VESSEL)

    async def talk(client: Client, _explorer: Explorer) -> None:
        await client.first("paint", tool="erase", structure="vessel", points=[point], radius_mm=2.0)

    with_client(painted, talk)
    lung = lung_of(painted)
    assert not lung.label_at(np.array(point)) & VESSEL
    anew = la.load_patient(painted.patient, cache=painted.patient.parent / "other")
    assert np.array_equal(lung.labels, anew.labels), "made of the lung before, or from nothing"
    assert lung.fields.keys() == anew.fields.keys()
    for name, field in anew.fields.items():
        assert np.array_equal(lung.fields[name].corners, field.corners), name
    assert any("vessel" in words and "erased" in words for words in lung.warnings)


def test_pages_that_show_the_masks_from_before_are_closed(painted: PatientSource) -> None:
    point = middle(lung_of(painted), VESSEL)

    async def talk(client: Client, explorer: Explorer) -> None:
        assert explorer.address is not None
        async with opened(explorer.address) as other:
            await client.first("paint", tool="erase", structure="vessel", points=[point])
            assert (await other.socket.receive()).data == 1012
        assert (await client.first("place", point=point))[0]["tissue"] != "vessel"

    with_client(painted, talk)


def test_a_stroke_that_leaves_no_airway_is_refused_and_taken_back(painted: PatientSource) -> None:
    lung = lung_of(painted)
    low, high = (lung.tree.points_lps[0] + np.array([0.0, 0.0, shift]) for shift in (-1.0, 0.0))

    async def talk(client: Client, _explorer: Explorer) -> None:
        points = [list(map(float, each)) for each in (low, high)]
        answer = (await client.first("paint", tool="cut", structure="airway", points=points, radius_mm=30.0))[
            0
        ]
        assert answer["answer"] == "error"
        assert not corrections_file(painted.patient).exists()
        assert (await client.first("place", point=points[1]))[0]["tissue"] == "airway lumen"

    with_client(painted, talk)


def test_a_few_fissures_are_never_painted_where_none_are_known(painted: PatientSource) -> None:
    text = (painted.patient / "patient.toml").read_text()
    lines = [line for line in text.splitlines() if not line.startswith("fissures")]
    (painted.patient / "patient.toml").write_text("\n".join(lines) + "\n")

    async def talk(client: Client, _explorer: Explorer) -> None:
        point = middle(lung_of(painted), VESSEL)
        answer = (await client.first("paint", tool="paint", structure="fissure", points=[point]))[0]
        assert "came without fissures" in answer["error"]["found"]

    with_client(painted, talk)


def test_cut_and_join_mend_an_airway(painted: PatientSource) -> None:
    """A cut frees what lies behind it, and a bridge along the air brings it back."""
    lung = lung_of(painted)
    tree = lung.tree
    ends = [branch for branch in range(tree.n_branches) if len(tree.branch_points(branch)) > 12]
    points = tree.branch_points(
        max(ends, key=lambda branch: tree.distance_from_root_mm[tree.branch_points(branch)[-1]])
    )
    behind, cut, ahead = (tree.points_lps[points[at]] for at in (-1, len(points) // 2, 1))

    async def talk(client: Client, _explorer: Explorer) -> None:
        answer = (
            await client.first("paint", tool="cut", structure="airway", points=[cut.tolist()], radius_mm=3.0)
        )[0]
        assert answer["answer"] == "painted", answer
        assert not lung_of(painted).label_at(behind) & LUMEN
        joined = [ahead.tolist(), behind.tolist()]
        answer = (await client.first("paint", tool="join", structure="airway", points=joined, radius_mm=1.5))[
            0
        ]
        assert answer["answer"] == "painted", answer
        assert lung_of(painted).label_at(behind) & LUMEN

    with_client(painted, talk)


@pytest.mark.browser
@pytest.mark.slow
@pytest.mark.skipif(bool(browser.missing()), reason=browser.missing() or "all there")
def test_a_stroke_in_a_slice_becomes_another_plan(painted: PatientSource, tmp_path: Path) -> None:
    served = Served(painted)
    try:
        with Page(1440, 900) as page:
            page.open(served.address.url)
            first = page.target(TARGET)["plan"]
            page.run("document.getElementById('mend').open = true")
            exit_lps = np.array(first["exit_lps"])
            between = 0.5 * (exit_lps + np.array(page.state()["target_lps"]))
            page.run("window.lungaccessExplorer.moveTo(arguments[0])", between.tolist())
            page.frame()
            canvas = "document.getElementById('slice-axial')"
            width, height = page.run(f"return [{canvas}.clientWidth, {canvas}.clientHeight]")

            def stroke() -> None:
                page.pointer("mousePressed", "slice-axial", width / 2 - 4, height / 2)
                page.pointer("mouseMoved", "slice-axial", width / 2 + 4, height / 2)
                page.screenshot(tmp_path / "stroke.png")
                page.pointer("mouseReleased", "slice-axial", width / 2 + 4, height / 2)

            for control, value in {
                "mend-structure": "vessel",
                "mend-tool": "paint",
                "mend-radius": "2",
            }.items():
                page.choose(control, value)
            stroke()
            page.wait("document.getElementById('mend-words').textContent.includes('changed')")
            second = page.wait(f"{PLANNED} && s.plan.digest !== {json.dumps(first['digest'])}")
            page.screenshot(tmp_path / "mended.png")
            assert page.state()["place"] is not None
            assert second["plan"]["digest"] != first["digest"]
            page.click("mend-undo")
            page.wait(f"{PLANNED} && s.plan.digest === {json.dumps(first['digest'])}")
            # One slice alone, of a fissure, and what is as dense within a level.
            page.click("mend-flat")
            for tool in ("paint", "fill"):
                for control, value in {
                    "mend-structure": "fissure",
                    "mend-tool": tool,
                    "mend-level": "60",
                }.items():
                    page.choose(control, value)
                stroke()
                page.wait("/changed|nothing|no /i.test(document.getElementById('mend-words').textContent)")
            assert page.messages() == []
    finally:
        served.stop()
