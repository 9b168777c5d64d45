"""Picture, page and command of a `NoPlan`: they show what the explanation says."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import lungaccess as la
from anatomy.lung import Lung
from lungaccess.cli import app as cli
from lungaccess.cli.exit_code import ExitCode
from lungaccess.judging.explanation import FAILS, Explanation, explain_no_plan
from lungaccess.showing.report import no_plan_png
from lungaccess.showing.report.html import no_plan_page
from tests.lungaccess.loading import load_with
from tests.lungaccess.points import FAR_TARGET
from tests.lungaccess.showing.report import browser

SYSTEM = la.load_system("ultrathin")
NO_TIME_S = 1e-9


@pytest.fixture(scope="module")
def explanation(small_lung: Lung) -> Explanation:
    """Of a target out of reach: what blocks, the starts and the nearest point."""
    target = la.resolve_target(small_lung, FAR_TARGET)
    atlas = la.build_atlas(small_lung, SYSTEM, rotations=12, stop_spacing_mm=4.0, site_spacing_mm=2.0)
    with pytest.raises(la.NoPlan) as caught:
        list(
            la.plan(
                small_lung, SYSTEM, target, atlas=atlas, iterations=5, counterfactuals=False, goal="default"
            )
        )

    def none(*_: object, **__: object) -> la.Atlas:
        from lungaccess.judging.explanation.explain import OutOfTime

        raise OutOfTime

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("lungaccess.planning.coupled.scope_changes", none)
        patched.setattr("lungaccess.judging.explanation.explain.UnreachableProof", none)
        return explain_no_plan(
            small_lung, SYSTEM, target, caught.value, atlas=atlas, time_s=None, atlas_of=none
        )


def test_the_picture_is_drawn_in_colours_of_the_reasons(
    explanation: Explanation, small_lung: Lung, tmp_path: Path
) -> None:
    from PIL import Image

    from lungaccess.showing.report.colours import START_COLOURS

    pixels = np.asarray(Image.open(no_plan_png(explanation, small_lung, tmp_path / "a.png")).convert("RGB"))
    grey = tuple(int(START_COLOURS["out of reach"][n : n + 2], 16) for n in (1, 3, 5))
    assert (pixels == grey).all(axis=-1).sum() > 200
    assert set(START_COLOURS) == set(FAILS)


@pytest.fixture(scope="module")
def page(explanation: Explanation, small_lung: Lung, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return no_plan_page(explanation, small_lung, tmp_path_factory.mktemp("page") / "no_plan.html")


def test_the_page_begins_with_the_headline_and_lists_what_was_not_tried(
    page: Path, explanation: Explanation
) -> None:
    text = page.read_text(encoding="utf-8")
    body = text[text.index("<body>") :]
    assert body.index("No plan found with ultrathin") < body.index("<main>")
    assert "Not tried: nothing follows from these" in body and "change of the bronchoscope" in body
    assert "http" not in body.split('<script type="module">', maxsplit=1)[0]
    assert len(text) < 15_000_000


@pytest.fixture(scope="module")
def window(page: Path) -> Iterator[browser.Browser]:
    with browser.Browser(1000, 700) as opened:
        opened.open(page)
        yield opened


@pytest.mark.slow
@pytest.mark.browser
@pytest.mark.skipif(bool(browser.missing()), reason=browser.missing() or "all there")
class TestBrowser:
    def test_it_shows_the_starts_by_reason(self, window: browser.Browser, explanation: Explanation) -> None:
        state = window.state()
        assert window.messages() == [] and state["gl_error"] == 0
        starts = explanation.starts
        assert starts is not None
        names = list(FAILS)
        cells = {names[code]: int(n) for code, n in enumerate(np.bincount(starts.why)) if n}
        assert state["starts"] == cells
        assert state["place_lps"] == pytest.approx(explanation.target.lps_mm.tolist())

    def test_a_switch_hides_its_starts(self, window: browser.Browser) -> None:
        before = window.state()["shown"]
        assert all(on for key, on in before.items() if key.startswith("start "))
        window.run("document.querySelector('#starts input').click()")
        window.frame()
        after = window.state()["shown"]
        assert [key for key in before if before[key] != after[key]] == [
            next(key for key in before if key.startswith("start "))
        ]

    @pytest.mark.slow
    def test_the_list_of_places_brings_the_slices_back_to_the_target(self, window: browser.Browser) -> None:
        target = window.state()["place_lps"]
        window.run("window.lungaccessReport.set(arguments[0])", [mm + 7.0 for mm in target])
        assert window.state()["slices"]["place_lps"] != pytest.approx(target)
        window.run(
            "const s = document.getElementById('place'); s.value = '0';s.dispatchEvent(new Event('change'))"
        )
        window.frame()
        state = window.state()
        assert state["place_lps"] == pytest.approx(target) == state["slices"]["place_lps"]


@pytest.mark.slow
@pytest.mark.parametrize("as_json", [False, True])
def test_the_command_leaves_what_it_learned_and_exits_1(
    as_json: bool, small_lung: Lung, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    """Without any time one preset is tried, the one whose atlas is kept; the rest is listed as not tried."""
    load_with(monkeypatch, lambda *_, **__: small_lung)
    coarse = {"rotations": 4, "stop_spacing_mm": 10.0, "site_spacing_mm": 5.0}
    monkeypatch.setattr(
        "lungaccess.planning.coupled.open_atlas",
        lambda lung, system, **_: la.build_atlas(lung, system, **coarse),
    )
    monkeypatch.setattr(
        "lungaccess.planning.coupled.atlas_is_kept", lambda _lung, system, **_: system.name == "stylet-needle"
    )
    (tmp_path / "plan.json").write_text("{}")
    words = [
        "plan", "toy", "--target", FAR_TARGET, "--system", "ultrathin", "--iterations", "3", "--no-pictures",
        "--explain-time", str(NO_TIME_S), "--out", str(tmp_path), "--force", *(["--json"] if as_json else []),
    ]  # fmt: skip
    assert cli.main(words) == ExitCode.NEGATIVE
    said = capsys.readouterr().out
    stored = json.loads((tmp_path / "no_plan.json").read_text())
    done = [part["part"] for part in stored["parts"] if part["outcome"] == "done"]
    assert done == ["preset stylet-needle"] and len(stored["parts"]) > 5
    assert [each["system"] for each in stored["presets"] if each["tried"]] == ["stylet-needle"]
    assert stored["headline"].count("not tried: lung-default, tubes-only, thin-scope") == 1
    if as_json:
        record = json.loads(said)
        assert record["headline"] == stored["headline"] and record["files"] == ["no_plan.json"]
    else:
        assert "Not tried: nothing follows from these" in said
    assert not (tmp_path / "plan.json").exists()


def test_a_command_that_does_not_choose_says_who_does(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["certify", "toy", "--nodule", "--system", "auto"]) == ExitCode.BAD_INPUT
    said = " ".join(capsys.readouterr().err.split())
    assert "does not choose a system" in said and "plan --system auto" in said
