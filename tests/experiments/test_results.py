"""Result files and RESULTS.md: complete, repeatable, and silent about where they were made."""

from __future__ import annotations

import json
import os
import platform
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from anatomy.base.errors import FileError
from anatomy.lung import Lung
from experiments import pan2025_tour, run_all, write_results
from experiments.support import anatomies, results
from experiments.support.headlines import HEADLINES, MEASURED_ON
from experiments.support.results import PNG_BYTES, Result, Row, cells, number, write_result

CHECKOUT = Path(__file__).resolve().parents[2]


def made(name: str = "rosell2012", setting: str = "full", **more: Any) -> Result:
    """Return a result with two rows."""
    result = Result(
        name=name, title="A | title", source="fig. 6", setting=setting, seeds=[3, 1, 2, 7],
        conditions={"anatomy": "phantom"}, not_reproduced=["their CT"], **more,
    )  # fmt: skip
    result.rows += [
        Row(quantity="time", ours=0.0079, paper=10.0, unit="s", note="a | b"),
        Row(quantity="no number of theirs", ours=3.0),
    ]
    return result


def figure_of(pixels: np.ndarray, width_in: float = 3.0) -> Figure:
    figure = Figure(figsize=(width_in, 2.0 / 3.0 * width_in))
    figure.add_axes((0.0, 0.0, 1.0, 1.0)).imshow(pixels, interpolation="nearest", aspect="auto", cmap="gray")
    return figure


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, ""), (float("nan"), ""), (0.0, "0"), (96.0, "96"), (116_893.0, "116893"),
        (0.0123456, "0.0123"), (-8.614, "-8.61"), (1234.6, "1235"), (3.2e-7, "3.20e-07"), (2.5e9, "2.50e+09"),
    ],
)  # fmt: skip
def test_numbers_have_three_digits_that_count(value: float | None, text: str) -> None:
    assert number(value) == text


def test_a_ratio_is_ours_over_theirs() -> None:
    assert cells(Row(quantity="q", ours=60.0, paper=40.0, unit="mm")) == ("q, mm", "40", "60", "1.50", "")
    assert cells(Row(quantity="q", ours=0.01, paper=10.0))[3] == "1 / 1000"
    assert cells(Row(quantity="q", ours=1.0))[3] == cells(Row(quantity="q", ours=None, paper=2.0))[3] == ""
    assert cells(Row(quantity="q", ours=1.0, paper=0.0))[3] == ""


def test_a_stored_result_is_complete(tmp_path: Path) -> None:
    result = made(figure=figure_of(np.eye(8)))
    file = write_result(result, tmp_path)
    assert file == tmp_path / "full" / "rosell2012.json"
    stored = json.loads(file.read_text())
    assert Row(**stored["rows"][0]) == result.rows[0]
    assert stored["seeds"] == [3, 1, 2, 7]
    assert stored["machine"]["libraries"]["numpy"] == np.__version__
    assert stored["machine"]["cores"] >= 1
    assert stored["wall_s"] >= 0.0
    assert stored["cpu_s"] >= 0.0
    assert sorted(each.name for each in file.parent.iterdir()) == ["rosell2012.json", "rosell2012.png"]


def test_no_result_names_the_machine_or_a_folder(tmp_path: Path) -> None:
    file = write_result(made(figure=figure_of(np.eye(8))), tmp_path)
    write_results.write_page(tmp_path, tmp_path / "RESULTS.md")
    for text in (file.read_text(), *(page.read_text() for page in tmp_path.glob("*.md"))):
        assert not re.search(r"(?<![\w.\]`(])/\w+/", text)
        assert str(tmp_path) not in text
        assert str(CHECKOUT) not in text
        assert len(platform.node()) < 4 or platform.node() not in text


def test_numbers_that_are_not_finite_are_stored_as_none(tmp_path: Path) -> None:
    result = made()
    result.add("no answer", float("nan"), np.float64(2.0))
    stored = json.loads(write_result(result, tmp_path).read_text())
    assert stored["rows"][-1]["ours"] is None
    assert stored["rows"][-1]["paper"] == 2.0


def test_a_picture_is_made_small_enough() -> None:
    shades = np.random.default_rng(0).random((60, 90))
    for pixels in (np.eye(4), shades):
        assert len(results.small_png(figure_of(pixels, 12.0))) <= PNG_BYTES


def test_a_picture_that_cannot_be_made_small_is_refused(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(results, "PNG_BYTES", 500)
    with pytest.raises(FileError, match="kB"):
        write_result(made(figure=figure_of(np.random.default_rng(0).random((60, 90)))), tmp_path)
    assert not list(tmp_path.rglob("*.*"))


def test_a_picture_is_the_same_twice(tmp_path: Path) -> None:
    pictures = [results.small_png(figure_of(np.eye(8))) for _ in range(2)]
    assert pictures[0] == pictures[1]
    (tmp_path / "a.png").write_bytes(pictures[0])
    assert Image.open(tmp_path / "a.png").info.keys() <= {"dpi"}


def test_the_page_has_every_row_condition_and_reason(tmp_path: Path) -> None:
    write_result(made(figure=figure_of(np.eye(8))), tmp_path / "results")
    write_results.write_page(tmp_path / "results", tmp_path / "RESULTS.md")
    text = (tmp_path / "results" / "tables.md").read_text()
    for line in (
        "| time, s | 10 | 0.00790 | 1 / 1266 | a \\| b |", "| no number of theirs |  | 3 |  |  |",
        "- anatomy: phantom", "- seeds: 1 to 3, 7", "- their CT", "Compared with: fig. 6.",
        "](full/rosell2012.png)", "quick setting: **not run, or failed**",
        "| quantity | paper | ours, full | ratio | note |",
    ):  # fmt: skip
        assert line in text
    assert (tmp_path / "results/full/rosell2012.png").is_file()


def test_the_page_tells_which_studies_are_missing(tmp_path: Path) -> None:
    write_result(made(), tmp_path)
    write_results.write_page(tmp_path, tmp_path / "RESULTS.md")
    text = (tmp_path / "tables.md").read_text()
    assert "| `rosell2012` | yes | **missing** |" in text
    for name in run_all.STUDIES:
        assert f"`{name}`" in text
        if name != "rosell2012":
            assert f"| `{name}` | **missing** | **missing** |" in text
            assert f"`python -m experiments.{name}` was not run, or failed" in text


def test_results_md_has_every_study_and_few_rows(tmp_path: Path) -> None:
    result = made()
    result.rows[0] = Row(quantity=HEADLINES["rosell2012"][0], ours=0.02, paper=31.0, unit="s")
    write_result(result, tmp_path / "results")
    write_result(made("pan2025_tour", "quick", progress="3 of 9 runs"), tmp_path / "results")
    write_results.write_page(tmp_path / "results", tmp_path / "RESULTS.md")
    text = (tmp_path / "RESULTS.md").read_text()
    link = "[`rosell2012`](results/tables.md#rosell2012)"
    assert f"| {link} | {HEADLINES['rosell2012'][0]}, s | 31 | 0.0200 | 1 / 1550 | full |" in text
    assert text.count(link) == 1
    assert "| quick, **unfinished: 3 of 9 runs** |" in text
    assert "**unfinished: 3 of 9 runs**" in (tmp_path / "results" / "tables.md").read_text()
    for name in run_all.STUDIES:
        assert f"](results/tables.md#{name}) |" in text
    assert text.count("**no result is kept**") == len(run_all.STUDIES) - 2


def test_results_md_names_the_page_of_a_study_whose_full_result_is_not_kept(tmp_path: Path) -> None:
    name, page = next(iter(MEASURED_ON.items()))
    write_result(made(name, "quick"), tmp_path)
    write_results.write_page(tmp_path, tmp_path / "RESULTS.md")
    where = f"more was measured once: [page]({page})"
    assert f"| quick; {where} |" in (tmp_path / "RESULTS.md").read_text()
    write_result(made(name, "full"), tmp_path)
    write_results.write_page(tmp_path, tmp_path / "RESULTS.md")
    assert where not in (tmp_path / "RESULTS.md").read_text().split(f"#{name}")[1].splitlines()[0]


def test_each_headline_is_a_row_of_the_stored_results() -> None:
    found = write_results.read_all(CHECKOUT / "results")
    for name, quantities in HEADLINES.items():
        made = found.get(name, {})
        if "full" in made and not made["full"].get("progress"):
            assert set(quantities) <= {row.quantity for row in made["full"]["rows"]}, name
    assert set(HEADLINES) | set(write_results.MEASURED_ON) == set(run_all.STUDIES)
    assert all((CHECKOUT / page).is_file() for page in write_results.MEASURED_ON.values())


def test_the_stored_pages_are_those_of_the_stored_results(tmp_path: Path) -> None:
    found = write_results.read_all(CHECKOUT / "results")
    assert (CHECKOUT / "results" / "tables.md").read_text() == write_results.page(found, "../RESULTS.md")
    assert (CHECKOUT / "RESULTS.md").read_text() == write_results.headlines(
        found, "results/tables.md", "docs"
    )
    assert len((CHECKOUT / "RESULTS.md").read_text().splitlines()) < 60


def test_both_settings_stand_side_by_side(tmp_path: Path) -> None:
    quick = made(setting="quick")
    quick.rows[0] = Row(quantity="time", ours=0.5, paper=10.0, unit="s")
    quick.rows.append(Row(quantity="quick only", ours=4.0))
    for result in (made(), quick):
        write_result(result, tmp_path)
    write_results.write_page(tmp_path, tmp_path / "RESULTS.md")
    text = (tmp_path / "tables.md").read_text()
    assert "| time, s | 10 | 0.00790 | 0.500 | 1 / 1266 | a \\| b |" in text
    assert "| quick only |  |  | 4 |  |  |" in text
    assert "| no number of theirs |  | 3 | 3 |  |  |" in text


def test_a_study_without_a_paper_has_no_column_for_one(tmp_path: Path) -> None:
    result = made("closed_loop")
    result.rows = [Row(quantity="reached", ours=95.6, unit="%", note="closed loop")]
    write_result(result, tmp_path)
    write_results.write_page(tmp_path, tmp_path / "RESULTS.md")
    text = (tmp_path / "tables.md").read_text()
    assert (
        "| quantity | ours, full | note |\n| --- | --- | --- |\n| reached, % | 95.6 | closed loop |" in text
    )


def test_a_study_that_the_page_does_not_know_is_shown(tmp_path: Path) -> None:
    write_result(made("of_a_user"), tmp_path)
    write_results.write_page(tmp_path, tmp_path / "RESULTS.md")
    assert "### A | title: `of_a_user`" in (tmp_path / "tables.md").read_text()


def test_the_same_files_give_the_same_bytes(tmp_path: Path) -> None:
    for name in ("pan2025_tour", "rosell2012", "of_a_user"):
        for setting in write_results.SETTINGS:
            write_result(made(name, setting), tmp_path / "a")
    pages = []
    for folder in ("a", "b"):
        home = tmp_path / folder
        for setting in write_results.SETTINGS:
            (home / setting).mkdir(parents=True, exist_ok=True)
            for file in sorted((tmp_path / "a" / setting).iterdir(), reverse=True):
                (home / setting / file.name).write_bytes(file.read_bytes())
        write_results.write_page(home, home / "RESULTS.md")
        pages.append([(home / name).read_bytes() for name in ("RESULTS.md", "tables.md")])
    assert pages[0] == pages[1]


@pytest.mark.parametrize("text", ["{", "[]", '{"rows": []}', '{"rows": [{"what": 1}]}'])
def test_a_damaged_result_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "rosell2012.json").write_text(text)
    with pytest.raises(FileError, match="is damaged"):
        write_results.write_page(tmp_path, tmp_path / "RESULTS.md")
    assert not (tmp_path / "RESULTS.md").exists()


def test_data_that_is_not_there_is_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("LUNGACCESS_DATA", raising=False)
    assert anatomies.data_folder() is None
    assert anatomies.default_anatomies() == ("phantom",)
    with pytest.raises(FileError, match="is not set"):
        anatomies.anatomy("Patient1")
    monkeypatch.setenv("LUNGACCESS_DATA", str(tmp_path))
    assert anatomies.default_anatomies() == ("Patient1", "Patient2")
    with pytest.raises(FileError, match="lacks it"):
        anatomies.require_data("needle")
    monkeypatch.setenv("LUNGACCESS_DATA", str(tmp_path / "nothing"))
    with pytest.raises(FileError, match="not a folder"):
        anatomies.data_folder()


def test_a_study_that_fails_loses_its_old_result_and_no_other(tmp_path: Path) -> None:
    stale, other = (write_result(made(name, "quick"), tmp_path) for name in ("no_such_study", "pan2025_tour"))
    assert not run_all.run_study("no_such_study", tmp_path, "quick", 1)
    assert not stale.exists()
    assert other.exists()


def test_all_others_are_run_when_one_fails(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    ran = []

    def run_study(name: str, folder: Path, setting: str, seed: int) -> bool:
        ran.append((name, setting, seed))
        if name == "li2021_route":
            return False
        write_result(made(name, setting), folder)
        return True

    monkeypatch.setattr(run_all, "run_study", run_study)
    page = tmp_path / "RESULTS.md"
    monkeypatch.setattr("sys.argv", ["run_all", "--quick", "--results", str(tmp_path), "--out", str(page)])
    assert run_all.main() == 1
    assert ran == [(name, "quick", 1) for name in run_all.STUDIES]
    assert (tmp_path / "tables.md").read_text().count("**No result.**") == 1


@pytest.mark.slow
def test_a_quick_study_stores_its_table(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, small_lung: Lung
) -> None:
    for name, value in {"QUICK_MODELS": 2, "QUICK_DRAWS": 1, "LESIONS": (3, 4)}.items():
        monkeypatch.setattr(pan2025_tour, name, value)
    monkeypatch.setattr(pan2025_tour, "anatomy", lambda _name: small_lung)
    monkeypatch.setattr("sys.argv", ["pan2025_tour", "--quick", "--seed", "5", "--results", str(tmp_path)])
    pan2025_tour.main()
    stored = json.loads((tmp_path / "quick" / "pan2025_tour.json").read_text())
    values = {row["quantity"]: row["ours"] for row in stored["rows"]}
    assert stored["seeds"] == [5, 6]
    assert 0.0 < values["time saved, exits of least resistance, mean"] < 100.0
    assert values["longer than the exact tour, least resistance, mean"] >= 0.0
    assert values["most passes of a stretch"] <= 2.0
    assert os.path.getsize(tmp_path / "quick" / "pan2025_tour.png") <= PNG_BYTES
