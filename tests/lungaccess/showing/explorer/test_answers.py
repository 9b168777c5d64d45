"""The answers: exits, plans as the command makes them, reach, appraisal, files; the latest question wins."""

from __future__ import annotations

import asyncio
import json
import zipfile
from pathlib import Path
from typing import Any

import aiohttp
import numpy as np
import pytest

import lungaccess as la
from lungaccess.cli.app import main
from lungaccess.planning.coupled import DirectArcs
from lungaccess.planning.reachability import KINDS
from lungaccess.plans.plan import Plan
from lungaccess.problem.task import Task
from lungaccess.showing.explorer import Explorer
from tests.lungaccess.planning.coupled.planning import TARGET
from tests.lungaccess.showing.explorer.client import Client, source_of, with_client

SYSTEM = {"system": "ultrathin"}
ITERATIONS = 60


def plain(text: str) -> dict[str, Any]:
    """Return a plan without its times."""
    values = json.loads(text)
    values.pop("timing")
    return values


async def fetched(explorer: Explorer, link: str) -> bytes:
    address = explorer.address
    assert address is not None
    sent = {"Cookie": f"{address.cookie}={address.token}"}
    async with aiohttp.ClientSession(headers=sent) as session, session.get(address.origin + link) as answer:
        assert answer.status == 200 and answer.headers["Content-Disposition"].startswith("attachment")
        return await answer.read()


@pytest.mark.slow
def test_a_click_its_plan_its_files_and_the_command(
    patient: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One page from the click to the files; the plan is that of the command but for its times."""
    seen: dict[str, Any] = {}

    async def talk(client: Client, explorer: Explorer) -> None:
        facts, _none = await client.first("patient")
        assert facts["patient"] and {each["name"] for each in facts["systems"]} >= {
            "ultrathin",
            "lung-default",
        }
        prepared, tips = await client.first("prepare", what_if=SYSTEM)
        assert prepared["deployments"] == tips["deployments"].sum() > 0
        exits, arrays = (await client.ask("exits", target=TARGET, what_if=SYSTEM))[-2]
        assert exits["complete"] and len(arrays["entry"]) == len(arrays["points"]) > 0
        seen["exits"] = arrays
        plans = [
            m for m, _ in await client.ask("plan", target=TARGET, what_if=SYSTEM, iterations=ITERATIONS)
        ][:-1]
        chances = [chance for _time, _iteration, chance in plans[-1]["curve"]]
        # The last plan may be that before with a simpler motion, whose chance is the same.
        assert chances == sorted(chances) and len(set(chances)) >= len(chances) - 1
        assert plans[-1]["final"] and plans[0]["packed"]["target_lps"] == exits["target_lps"]
        seen["plan"] = plans[-1]
        appraisal, _none = await client.first("appraise", plan=plans[-1]["digest"])
        assert appraisal["accepted"] and "Geometry proved and checked" in appraisal["headline"]["text"]
        for what in ("plan.json", "summary.json", "cost_over_time.csv", "system.toml", "slicer.zip"):
            found = await client.ask("export", plan=plans[-1]["digest"], what=what)
            link = next(m["address"] for m, _ in found if m["answer"] == "link")
            seen[what] = await fetched(explorer, link)
        chosen, _none = (
            await client.ask(
                "plan", target=TARGET, what_if=SYSTEM, entry=int(arrays["entry"][0]), iterations=ITERATIONS
            )
        )[-2]
        assert chosen["final"]
        assert np.linalg.norm(np.array(chosen["exit_lps"]) - arrays["points"][0]) <= 2.0 + 1e-3
        tip = int(arrays["tip"][0])
        held, _none = (
            await client.ask("plan", target=TARGET, what_if=SYSTEM, scope_tip=tip, iterations=ITERATIONS)
        )[-2]
        seen["through"] = [chosen, held]
        away = np.linalg.norm(np.array(held["scope_tip_lps"]) - tips["tips"][tip, :3])
        assert away <= 1.5 + 1e-3

    with_client(source_of(patient), talk)
    assert b"".join((seen["plan.json"],)) and zipfile.is_zipfile(
        _written(tmp_path / "s.zip", seen["slicer.zip"])
    )
    monkeypatch.chdir(tmp_path)
    for each in (*seen["through"], seen["plan"]):
        assert main([*_words(each["command"]), "--no-pictures"]) == 0
        assert Plan.load(tmp_path / "plan" / "plan.json").digest == each["digest"]
    assert plain((tmp_path / "plan" / "plan.json").read_text()) == plain(seen["plan.json"].decode())
    assert json.loads(seen["summary.json"])["digest"] == Plan.load(tmp_path / "plan" / "plan.json").digest
    _are_feasible(patient, seen["exits"])


def _written(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path


def _words(command: str) -> list[str]:
    import shlex

    words = shlex.split(command)
    assert words[0] == "lungaccess"
    return words[1:]


def _are_feasible(patient: Path, exits: dict[str, Any]) -> None:
    """Every exit that is painted has a plan; every clear arc of the atlas belongs to an exit."""
    lung, system = la.load_patient(patient, cache=patient.parent / "cache"), la.load_system("ultrathin")
    atlas = la.open_atlas(lung, system, cache=patient.parent / "cache")
    target = la.resolve_target(lung, TARGET)
    arcs = DirectArcs(Task(lung=lung, system=system, target=target), atlas)
    clear = arcs.clear()
    assert exits["count"].sum() == len(clear)
    assert set(exits["entry"]) <= set(clear.tolist())
    np.testing.assert_array_equal(atlas.deployments.site[exits["entry"]], exits["tip"])
    for entry, point in zip(exits["entry"][:5].tolist(), exits["points"], strict=False):
        candidate = arcs.proved(entry)
        assert candidate is not None
        tip, deployment = candidate.tip.lps_from_scope_tip, candidate.deployment
        np.testing.assert_allclose(deployment.points(tip, [deployment.exit_mm])[0], point, atol=1e-3)


@pytest.mark.slow
def test_the_latest_question_wins(patient: Path) -> None:
    async def talk(client: Client, _explorer: Explorer) -> None:
        await client.ask("prepare", what_if=SYSTEM)
        question = {"what_if": SYSTEM, "iterations": 20_000}
        first = await client.send("plan", target="nodule 1", **question)
        second = await client.send("plan", target=TARGET, **question)
        third = await client.send("plan", target=TARGET, **(question | {"iterations": 5}))
        beside = await client.send("plan", target=TARGET, slot="compare", **(question | {"iterations": 5}))
        assert (await client.answers(first))[-1][0]["answer"] == "superseded"
        assert (await client.answers(second))[-1][0]["answer"] == "superseded"
        assert (await client.answers(third))[-1][0]["answer"] == "end"
        assert (await client.answers(beside))[-1][0]["answer"] == "end"
        long = await client.send("plan", target=TARGET, **question)
        await client.socket.send_str(json.dumps({"ask": "cancel", "id": long}))
        assert (await client.answers(long))[-1][0]["answer"] == "superseded"

    with_client(source_of(patient), talk)


@pytest.mark.slow
def test_other_answers_do_not_wait_for_a_long_search(patient: Path) -> None:
    async def talk(client: Client, _explorer: Explorer) -> None:
        await client.ask("prepare", what_if=SYSTEM)
        long = await client.send("plan", target=TARGET, what_if=SYSTEM, iterations=20_000)
        quick = await client.ask("exits", target=TARGET, what_if=SYSTEM)
        assert quick[-1][0]["answer"] == "end"
        early = [m["answer"] for m, _ in client.early if m["id"] == long]
        assert "end" not in early, "the exits came while the search went on"
        await client.socket.send_str(json.dumps({"ask": "cancel", "id": long}))
        assert (await client.answers(long))[-1][0]["answer"] == "superseded"

    with_client(source_of(patient), talk)


@pytest.mark.slow
def test_no_plan_is_explained_and_unreachable_needs_a_proof(patient: Path) -> None:
    async def talk(client: Client, _explorer: Explorer) -> None:
        what_if = SYSTEM | {"needle_length_mm": 6.0}
        answer, _none = await client.first("plan", target=TARGET, what_if=what_if, iterations=3)
        assert answer["answer"] == "no_plan" and answer["found"] and answer["reasons"]
        assert "unreachable" not in answer["found"].lower()
        for target, kind in (
            ("lps:500,0,0", "TargetError"),
            ("1,2,3", "FrameError"),
            ("nodule 99", "TargetError"),
        ):
            found = await client.ask("plan", target=target, what_if=SYSTEM)
            assert found[-1][0]["answer"] == "error" and found[-1][0]["error"]["kind"] == kind
        wrong = await client.ask("plan", target=TARGET, what_if=SYSTEM, entry=10**9)
        assert wrong[-1][0]["error"]["kind"] == "SettingsError"

    with_client(source_of(patient), talk)


@pytest.mark.slow
def test_the_reach_is_that_of_the_map_and_a_smaller_radius_keeps_it(patient: Path) -> None:
    maps: dict[float | None, Any] = {}

    async def talk(client: Client, _explorer: Explorer) -> None:
        for radius in (None, 30.0):
            what_if = SYSTEM if radius is None else SYSTEM | {"needle_radius_mm": radius}
            found = await client.ask("reach", around=[-45.6, 47.0, -65.1], what_if=what_if)
            grid = found[0][0]
            kinds = np.zeros(int(np.prod(grid["shape"])), dtype=np.uint8)
            for message, arrays in found[1:-1]:
                assert message["answer"] == "reach" and (kinds[arrays["voxels"]] == 0).all()
                kinds[arrays["voxels"]] = arrays["kinds"]
            assert found[-2][0]["share"] == 1.0 and np.count_nonzero(kinds) == grid["counted"]
            maps[radius] = kinds.reshape(grid["shape"])
            if radius is not None:
                first = found[1][1]["voxels"]
                assert len(first) == np.count_nonzero(maps[None] == KINDS["direct arc"]), (
                    "at once, as it was known"
                )

    with_client(source_of(patient), talk)
    lung, system = la.load_patient(patient, cache=patient.parent / "cache"), la.load_system("ultrathin")
    atlas = la.open_atlas(lung, system, cache=patient.parent / "cache")
    whole = la.map_reach(lung, system, spacing_mm=8.0, arcs=1, atlas=atlas).kinds.array
    np.testing.assert_array_equal(whole, maps[None])
    reached = maps[None] == KINDS["direct arc"]
    assert (maps[30.0][reached] == KINDS["direct arc"]).all()
    assert np.count_nonzero(maps[30.0] == KINDS["direct arc"]) >= np.count_nonzero(reached)


@pytest.mark.slow
def test_names_of_patients_and_places_come_as_plain_text(patient: Path) -> None:
    async def talk(client: Client, _explorer: Explorer) -> None:
        facts, _none = await client.first("patient")
        assert facts["folder"].endswith("<img src=x onerror=alert(1)>")
        place, _none = await client.first("place", point=[-45.6, 47.0, -65.1])
        assert place["tissue"] in ("lung tissue", "nodule") and place["may_be_target"]
        assert set(place["distance_mm"]) == {"airway", "vessel", "pleura", "fissure"}

    with_client(source_of(patient), talk)
    assert asyncio.iscoroutinefunction(talk)
