"""The page on what goes together says what is so: some cells in each run, all of them in the slow one."""

from __future__ import annotations

import numpy as np
import pytest

from anatomy.lung import Lung
from tests.lungaccess.planning.composition import DONE, PAGE, Cell, Table, cells, page

REASONS = ("needs a needle", "No plan to the target after 3000", "no bound of the best possible is known")
"""The only reasons for which a cell may not be done: the method draws paths of a needle, its random draws
find tubes that twist rarely, and nothing but a cost has a bound."""
SOME = 24


@pytest.fixture(scope="module")
def table(breathing_lung: Lung) -> Table:
    return Table(breathing_lung)


def _some() -> list[Cell]:
    quick = [each for each in cells() if "twisted" not in each.system and each.constraint != "kuntz2015"]
    return [quick[n] for n in np.random.default_rng(4).choice(len(quick), SOME, replace=False)]


@pytest.mark.parametrize("cell", _some(), ids=str)
def test_a_cell_is_done_or_refused_for_a_reason_of_the_page(table: Table, cell: Cell) -> None:
    outcome = table.run(cell)
    if outcome != DONE:
        assert any(reason in outcome for reason in REASONS)
        assert outcome in PAGE.read_text(encoding="utf-8")


@pytest.mark.slow
def test_the_page_is_that_of_the_table(table: Table) -> None:
    outcomes = {cell: table.run(cell) for cell in cells()}
    for outcome in set(outcomes.values()) - {DONE}:
        assert any(reason in outcome for reason in REASONS), outcome
    assert page(outcomes) == PAGE.read_text(encoding="utf-8")
