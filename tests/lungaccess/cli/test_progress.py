"""Suggestions for words that are wrong, and progress."""

from __future__ import annotations

from io import StringIO
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

import lungaccess as la
from anatomy.base.errors import SettingsError
from anatomy.base.words import did_you_mean
from lungaccess.cli import app as cli
from lungaccess.cli import progress
from lungaccess.cli.exit_code import ExitCode
from lungaccess.problem.system import load_system, preset_names


@pytest.mark.parametrize(
    ("words", "meant"),
    [
        (["pln"], "plan"),
        (["plan", "toy", "--nodul"], "--nodule"),
        (["plan", "toy", "--nodule", "--objective", "lenght"], "length"),
        (["plan", "toy", "--nodule", "--method", "kunz2015"], "kuntz2015"),
        (["plan", "toy", "--nodule", "--system", "lung_defualt"], "lung-default"),
        (["reach", "toy", "--compare", "ultra-thin"], "ultrathin"),
        (["completion", "bsh"], "bash"),
    ],
)
def test_what_was_meant_is_guessed(
    words: list[str], meant: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert cli.main([*words, "--out", str(tmp_path)] if words[0] == "reach" else words) == ExitCode.BAD_INPUT
    said = " ".join(capsys.readouterr().err.split())
    assert (
        f'Did you mean "{meant}"?' in said
        or f"Did you mean {meant}?" in said
        or (f"Did you mean '{meant}'?" in said)
    )


def test_objectives_of_the_library_are_guessed() -> None:
    with pytest.raises(SettingsError, match="Did you mean 'cost-map'"):
        la.Objective.of("cost-mpa")
    with pytest.raises(SettingsError) as caught:
        load_system("zzzz")
    assert "Did you mean" not in str(caught.value)


@given(st.sampled_from(preset_names()), st.integers(0, 30))
def test_a_name_with_a_letter_missing_is_found(name: str, place: int) -> None:
    place %= len(name)
    assert did_you_mean(name[:place] + name[place + 1 :], preset_names()) == f"Did you mean {name!r}?"


@given(st.floats(0.0, 1e4), st.floats(0.0, 1.0))
def test_the_time_left_is_in_proportion(passed_s: float, share: float) -> None:
    left = progress.remaining_s(passed_s, share, 1.0)
    if share < progress.LEAST_SHARE:
        assert left is None
    else:
        assert left is not None
        assert passed_s + left == pytest.approx(passed_s / share)
    assert progress.remaining_s(passed_s, share, None) is None


@pytest.fixture
def screen(monkeypatch: pytest.MonkeyPatch) -> StringIO:
    stream = StringIO()
    monkeypatch.setattr(
        progress, "progress_console", Console(file=stream, force_terminal=True, width=120, color_system=None)
    )
    return stream


def test_steps_are_shown_with_an_estimate(screen: StringIO) -> None:
    with progress.progress("reading [x]") as shown:
        shown.step("first")
        shown._progress.refresh()
        assert "reading [x]: first" in screen.getvalue() and "left" not in screen.getvalue()
        shown.step("second", 0.5)
        shown._progress.refresh()
    assert "reading [x]: second" in screen.getvalue() and "s left" in screen.getvalue()


def test_a_search_shows_best_cost_and_estimate(screen: StringIO) -> None:
    with progress.SearchDisplay(10.0, None) as shown:
        shown.update("local search", 5.0, 3, None)
        shown.better(5.0, "1.25")
        shown.update("local search", 6.0, 3, 1.25)
        shown._progress.refresh()
        shown.interrupted()
    said = screen.getvalue()
    for part in ("no plan yet", "cost 1.25", "improving the plan", "s left", "interrupted"):
        assert part in said


def test_nothing_is_shown_where_nobody_looks(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = StringIO()
    monkeypatch.setattr(progress, "progress_console", Console(file=stream, quiet=True, force_terminal=True))
    with progress.progress("working") as shown:
        shown.share(0.5)
    with progress.SearchDisplay(1.0, None) as search:
        search.better(0.1, "1.0")
    assert stream.getvalue() == ""
