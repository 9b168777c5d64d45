"""What a person sees first: commands by what they are for, and answers before details."""

from __future__ import annotations

import pytest
from cyclopts import App

from anatomy.lung import Lung
from lungaccess.cli import anatomy_tables
from lungaccess.cli.app import GROUPS, app, main


def test_the_help_shows_every_command_in_one_group(capsys: pytest.CaptureFixture[str]) -> None:
    grouped = [
        each.name[0] if isinstance(each, App) else each.__name__.replace("_", "-")
        for commands in GROUPS.values()
        for each in commands
    ]
    assert sorted(grouped) == sorted(name for name in app if not name.startswith("-"))
    assert main(["--help"]) == 0
    shown = capsys.readouterr().out
    places = [shown.index(f"─ {title} ─") for title in GROUPS]
    assert places == sorted(places)


def test_repairs_are_counted_and_listed_on_demand(small_lung: Lung) -> None:
    repairs = anatomy_tables.organ_record(small_lung)["tree"]["repairs"]
    assert repairs
    short, long = (anatomy_tables.anatomy_tables(small_lung, details=each) for each in (False, True))
    assert [each.row_count for each in long if each.title == "Repairs of the airway tree"] == [len(repairs)]
    assert not [each for each in short if each.title == "Repairs of the airway tree"]
    counted = [cell for cell in short[0].columns[1].cells if "--details" in str(cell)]
    assert len(counted) == 1
    assert sum(int(word) for word in str(counted[0]).split() if word.isdecimal()) == len(repairs)
