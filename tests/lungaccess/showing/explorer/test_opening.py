"""From an empty page to a plan: a folder is chosen, its CT segmented, a nodule outlined and planned to."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path

import aiohttp
import numpy as np
import pytest
import yarl

from anatomy.base.files import write_text
from anatomy.grid import Grid, Volume
from anatomy.lung import Lung
from anatomy.phantom import Phantom
from lungaccess.problem.nodules import nodules_of
from lungaccess.showing.explorer import Explorer, PatientSource
from lungaccess.showing.explorer.opening import nodule_near
from lungaccess.showing.report.segmented import patient_folder
from tests.anatomy.io.series import write_series
from tests.lungaccess.showing.explorer.client import Client, opened, with_client
from tests.lungaccess.showing.explorer.windows import PLANNED, Page, Served, explored, press
from tests.lungaccess.showing.report import browser


def thinned(volume: Volume, step: int) -> Volume:
    """Return every so manieth slice of an image."""
    matrix = volume.grid.lps_from_ijk @ np.diag([1.0, 1.0, float(step), 1.0])
    array = np.ascontiguousarray(volume.array[:, :, ::step])
    return Volume(grid=Grid(shape=array.shape, lps_from_ijk=matrix), array=array)


def test_a_nodule_that_was_pointed_at_is_told_from_others(small_lung: Lung) -> None:
    first, *others = nodules_of(small_lung)
    assert others
    assert nodule_near(small_lung, first.centre_lps) == first.number
    edge = small_lung.grid.lps(first.voxels)[np.argmax(first.voxels[:, 0])]
    assert nodule_near(small_lung, edge + np.array([2.0, 0.0, 0.0])) == first.number
    assert nodule_near(small_lung, edge + np.array([4.0, 0.0, 0.0])) is None


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder in which the explorer was started, without a patient."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def scanned(here: Path, small_phantom: Phantom) -> Path:
    """The folder of a CT in DICOM: the whole scan, one in thick slices, and a few slices of another one."""
    ct = small_phantom.ct
    (here / "disc").mkdir()
    few = Volume(grid=ct.grid.crop((0, 0, 20), (*ct.grid.shape[:2], 24)), array=ct.array[:, :, 20:24])
    for number, volume in enumerate((thinned(ct, math.ceil(3.1 / ct.grid.spacing_mm[2])), ct, few), start=1):
        write_series(here / "disc" / f"{number}", volume, number)
    return here / "disc"


def source(here: Path) -> PatientSource:
    return PatientSource(folder=None, system="ultrathin", cache=here / "cache")


def test_folders_are_listed_without_what_is_hidden(here: Path) -> None:
    for name in ("b", "a", ".hidden"):
        (here / name).mkdir()
    for name in ("ct.nii.gz", "note.txt"):
        (here / name).touch()

    async def talk(client: Client, _explorer: Explorer) -> None:
        shown, _ = await client.first("look")
        assert shown["folders"] == ["a", "b"]
        assert shown["files"] == ["ct.nii.gz"]
        assert (shown["path"], shown["parent"]) == (str(here), str(here.parent))
        assert (await client.first("look", path=str(here / "a")))[0]["folders"] == []
        missing, _ = await client.first("look", path=str(here / "nowhere"))
        assert missing["error"]["kind"] == "FileError"

    with_client(source(here), talk)


def test_what_is_no_ct_is_answered_in_words(here: Path, patient: Path) -> None:
    (here / "empty").mkdir()

    async def talk(client: Client, _explorer: Explorer) -> None:
        for folder, found in ((here / "empty", "is no patient"), (patient.parent.parent, "")):
            answer, _ = await client.first("open", path=str(folder))
            assert answer["answer"] == "error"
            assert found in answer["error"]["found"]
            assert answer["error"]["remedy"]
        unasked, _ = await client.first("patient")
        assert unasked["error"]["found"] == "No patient is open"

    with_client(source(here), talk)


def test_of_several_series_the_thin_one_of_the_whole_chest_is_proposed(scanned: Path) -> None:
    async def talk(client: Client, _explorer: Explorer) -> None:
        found = [
            each for each in await client.ask("open", path=str(scanned)) if each[0]["answer"] == "series"
        ]
        assert len(found) == 3
        first, arrays = found[0]
        assert [answer["proposed"] for answer, _ in found] == [True, False, False]
        assert arrays["picture"].shape == (*first["shape"], 4)
        assert np.ptp(arrays["picture"][..., 0]) > 100, "air and body differ"

    with_client(source(scanned.parent), talk)


def test_of_two_patients_in_a_folder_none_is_proposed(here: Path, small_phantom: Phantom) -> None:
    (here / "disc").mkdir()
    thin = thinned(small_phantom.ct, 8)
    for number, patient in enumerate(("Doe^A", "Doe^B"), start=1):
        write_series(here / "disc" / f"{number}", thin, number, PatientID=patient)

    async def talk(client: Client, _explorer: Explorer) -> None:
        found = [
            each
            for each, _ in await client.ask("open", path=str(here / "disc"))
            if each["answer"] == "series"
        ]
        assert [each["proposed"] for each in found] == [False, False]
        assert sorted(each["words"].partition(", patient ")[2][:6] for each in found) == ["1 of 2", "2 of 2"]
        assert "Doe" not in json.dumps(found), "names are nobody's to see"

    with_client(source(here), talk)


def test_thick_slices_are_a_question_with_its_consequence(scanned: Path) -> None:
    async def talk(client: Client, _explorer: Explorer) -> None:
        found = [each for each, _ in await client.ask("open", path=str(scanned / "1"))]
        drawn, answer = [each for each in found if each["answer"] != "progress"][:2]
        assert drawn["address"].endswith("/refused.png")
        assert answer["answer"] == "refused"
        assert "apart" in answer["found"]
        assert answer["thick_slices"] and answer["accept"] == []

    with_client(source(scanned.parent), talk)


def test_a_patient_that_is_opened_closes_the_pages_of_the_one_before(here: Path, patient: Path) -> None:
    async def talk(client: Client, explorer: Explorer) -> None:
        assert explorer.address is not None
        async with opened(explorer.address) as other:
            await client.send("open", path=str(patient))
            while (answer := (await client.next())[0])["answer"] == "progress":
                pass
            assert (answer["answer"], answer["patient"]) == ("opened", "phantom small 3")
            for each in (client, other):
                closed = await each.socket.receive()
                assert (closed.type, closed.data) == (aiohttp.WSMsgType.CLOSE, 1012)
        async with opened(explorer.address) as anew:
            assert (await anew.first("patient"))[0]["patient"] == "phantom small 3"

    with_client(PatientSource(folder=None, system="ultrathin", cache=patient.parent / "cache"), talk)


@pytest.fixture
def empty(here: Path) -> Iterator[tuple[Served, Page]]:
    """The page without a patient, in a window."""
    served = Served(source(here))
    try:
        with Page(1440, 900) as window:
            window.open(served.address.url)
            yield served, window
    finally:
        served.stop()


@pytest.mark.browser
@pytest.mark.slow
@pytest.mark.skipif(bool(browser.missing()), reason=browser.missing() or "all there")
def test_from_an_empty_page_to_a_checked_plan(
    scanned: Path, empty: tuple[Served, Page], small_phantom: Phantom
) -> None:
    """Three decisions: the series, the masks, the nodule."""
    served, page = empty
    press(page, "disc/")
    page.wait("!s.busy")
    page.click("take")
    page.wait("s.question.includes('Proposed')")
    press(page, "Proposed")
    warned = page.wait(
        "s.question.includes('The masks are in') && document.getElementById('picture').naturalWidth > 0"
    )
    assert str(scanned.parent / "disc-patient") in warned["question"]
    press(page, "The masks are right")
    explored(page)
    centre = [float(value) for value in small_phantom.nodules[0].centre_lps]
    page.run("window.lungaccessExplorer.moveTo(arguments[0])", centre)
    page.wait("!document.getElementById('outline').hidden")
    page.click("outline")
    page.wait("document.getElementById('outline').textContent.startsWith('Add this nodule')")
    page.run("window.before = true")
    page.click("outline")
    explored(page)
    state = page.wait(f"s.asked && s.asked.target.startsWith('nodule') && {PLANNED}")
    assert np.linalg.norm(np.subtract(state["target_lps"], centre)) < 3.0
    assert page.messages() == []
    hosts = {url.split("/")[2] for url in page.requests() if url.startswith(("http", "ws"))}
    assert hosts == {f"127.0.0.1:{served.address.port}"}, "nothing is asked of anything else"


def test_two_ct_of_one_name_have_a_folder_each(here: Path) -> None:
    """A CT, or a series of it, never takes up the patient of another one; its own it does."""
    from anatomy.io.own_masks import DESCRIPTION
    from anatomy.segmentation.folder import STATE

    def made(folder: Path, ct: Path, series: str | None) -> None:
        folder.mkdir()
        write_text(
            folder / STATE,
            json.dumps({"format": 1, "ct": "x", "ct_source": {"path": str(ct), "series": series}}),
        )
        (folder / DESCRIPTION).touch()

    one, other = (here / name / "ct.nii.gz" for name in ("one", "other"))
    for each in (one, other):
        each.parent.mkdir()
        each.touch()
    assert patient_folder(one) == Path("ct-patient")
    made(Path("ct-patient"), one, None)
    assert patient_folder(one) == Path("ct-patient")
    assert patient_folder(other) == Path("ct-patient-2")
    made(Path("ct-patient-2"), one, "1.2.3")
    assert patient_folder(one, "1.2.3") == Path("ct-patient-2")
    assert patient_folder(other) == Path("ct-patient-3")
    Path("ct-patient-3").mkdir()
    (Path("ct-patient-3") / DESCRIPTION).touch()
    assert patient_folder(other) == Path("ct-patient-4"), "masks that nobody knows to be its own"


def test_a_dropped_file_is_copied_beside_the_patients_and_nowhere_else(here: Path) -> None:
    async def talk(_client: Client, explorer: Explorer) -> None:
        address = explorer.address
        assert address is not None
        cookies = {address.cookie: address.token}
        async with aiohttp.ClientSession(cookies=cookies) as session, aiohttp.ClientSession() as stranger:

            async def put(name: str, by: aiohttp.ClientSession = session) -> tuple[int, str]:
                place = yarl.URL(f"{address.origin}/drop/{name}", encoded=True)
                async with by.put(place, data=b"x" * 3_000_000) as answer:
                    return answer.status, await answer.text()

            status, path = await put("head-1/1-IM%201.dcm")
            assert (status, Path(path)) == (200, here / "dropped" / "head-1" / "1-IM 1.dcm")
            assert Path(path).stat().st_size == 3_000_000
            for name in ("a/..%2Fb", "..%2F..%2Fx/y", ".ssh/x", "a/.bashrc", "a%5Cb/c", "x" * 201 + "/y"):
                assert (await put(name))[0] in (400, 404), name
            assert (await put("a/b", stranger))[0] == 403
        assert [each.name for each in (here / "dropped").rglob("*")] == ["head-1", "1-IM 1.dcm"]

    with_client(source(here), talk)


@pytest.mark.browser
@pytest.mark.slow
@pytest.mark.skipif(bool(browser.missing()), reason=browser.missing() or "all there")
def test_a_folder_that_is_dropped_is_opened(scanned: Path, empty: tuple[Served, Page]) -> None:
    _served, page = empty
    data = {"items": [], "files": [str(scanned)], "dragOperationsMask": 1}
    for kind in ("dragEnter", "dragOver", "drop"):
        page.command("Input.dispatchDragEvent", {"type": kind, "x": 300, "y": 300, "data": data})
    page.wait("s.question.includes('Proposed')")
    (copied,) = (scanned.parent / "dropped").iterdir()
    assert copied.name.startswith("disc-")
    assert len(list(copied.iterdir())) == len(list(scanned.rglob("*.dcm")))
    assert page.messages() == []
