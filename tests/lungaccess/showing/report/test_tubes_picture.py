"""The picture of deployed tubes: written whole, for one to three tubes, stable or not."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from anatomy.base.errors import FileError
from lungaccess.showing.report import style, tubes_png
from stages.tube.device import Tube
from stages.tube.following import deploy
from stages.tube.mechanics import TubeMechanics
from stages.tube.sequences import kuntz2015, together

SIZES = ((1.5, 1.3, 680.0), (1.9, 1.65, 640.0), (2.4, 2.1, 600.0))


def mechanics_of(*curvatures: float) -> TubeMechanics:
    return TubeMechanics(
        [
            Tube(
                outer_diameter_mm=outer, inner_diameter_mm=inner, length_mm=length,
                curved_length_mm=40.0 if curvature else 0.0, precurvature_per_mm=curvature,
            )
            for curvature, (outer, inner, length) in zip(curvatures, SIZES, strict=False)
        ]
    )  # fmt: skip


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """Keep every figure that is saved."""
    kept: list[Figure] = []
    save = style.save_png

    def keep(figure: Figure, path: Any) -> Path:
        kept.append(figure)
        return save(figure, path)

    monkeypatch.setattr(style, "save_png", keep)
    return kept


def graph(figure: Figure, label: str) -> tuple[Any, Any]:
    """The parts of a graph behind and ahead of the scope tip."""
    axes = figure.axes
    number = next(n for n, each in enumerate(axes) if each.get_ylabel() == label)
    return axes[number], axes[number + 1]


@pytest.mark.parametrize(
    "curvatures",
    [
        (0.025,),
        (0.025, 0.0),
        pytest.param((0.0, 0.0), marks=pytest.mark.slow),
        pytest.param((0.004, 0.004, 0.003), marks=pytest.mark.slow),
    ],
)
def test_one_two_and_three_tubes(curvatures: tuple[float, ...], tmp_path: Path) -> None:
    mechanics = mechanics_of(*curvatures)
    insertions = (60.0, 40.0, 20.0)[: len(curvatures)]
    found = deploy(mechanics, together(mechanics.tubes, 0.5, insertions), step_mm=10.0)
    path = tubes_png(
        found.final, tmp_path / "tubes.png", deployed=found, scope_diameter_mm=4.0, notes=["note"]
    )
    header = path.read_bytes()[:24]
    assert header[:8] == b"\x89PNG\r\n\x1a\n"
    assert int.from_bytes(header[16:20], "big") > 1500


def test_the_curves_are_those_of_the_equilibrium(tmp_path: Path, drawn: list[Figure]) -> None:
    mechanics = mechanics_of(0.0045, 0.0045)
    final = deploy(mechanics, kuntz2015(mechanics.tubes, (0.0, math.radians(120.0)), 40.0, 60.0)).final
    tubes_png(final, tmp_path / "tubes.png")
    for label, values in (
        ("psi (deg)", lambda s: np.degrees(final.angles(s))),
        ("u_z (deg/mm)", lambda s: np.degrees(final.torsion(s))),
        ("determinant", lambda s: final.determinant(s)[:, None]),
    ):
        behind, ahead = graph(drawn[0], label)
        for axes in (behind, ahead):
            for line in axes.lines:
                s, curve = np.asarray(line.get_xdata()), np.asarray(line.get_ydata())
                if len(s) > 2:
                    expected = values(s)
                    assert any(np.allclose(curve, column, equal_nan=True) for column in expected.T)
        assert behind.get_ylim() == ahead.get_ylim()
    behind, ahead = graph(drawn[0], "psi (deg)")
    assert behind.get_xlim()[0] == pytest.approx(-620.0) and ahead.get_xlim()[1] == pytest.approx(60.0)


@pytest.mark.slow
def test_what_is_unstable_dips_below_the_line(tmp_path: Path, drawn: list[Figure]) -> None:
    mechanics = mechanics_of(0.0125, 0.0125)
    unstable = mechanics.given_tip_angles((0.0, math.pi), (-620.0, -600.0))
    tubes_png(unstable, tmp_path / "tubes.png")
    behind, _ = graph(drawn[0], "determinant")
    assert min(np.asarray(behind.lines[0].get_ydata())) < 0.0
    assert behind.get_ylim()[0] < min(np.asarray(behind.lines[0].get_ydata()))


def test_every_axis_has_a_unit(tmp_path: Path, drawn: list[Figure]) -> None:
    final = mechanics_of(0.025, 0.0).given_base_angles((0.0, 0.0), (-630.0, -610.0))
    tubes_png(final, tmp_path / "tubes.png")
    labels = [axes.get_xlabel() for axes in drawn[0].axes if axes.get_xlabel()]
    assert len(labels) == 4 and all("(mm)" in label for label in labels)


@pytest.mark.slow
def test_earlier_steps_are_drawn_in_grey(tmp_path: Path, drawn: list[Figure]) -> None:
    mechanics = mechanics_of(0.025, 0.0)
    found = deploy(mechanics, kuntz2015(mechanics.tubes, 0.0, 20.0, 50.0), step_mm=5.0)
    tubes_png(found.final, tmp_path / "a.png")
    tubes_png(found.final, tmp_path / "b.png", deployed=found)
    without, with_steps = (len(figure.axes[0].lines) for figure in drawn)
    assert with_steps - without == 9


def test_a_missing_folder_is_said(tmp_path: Path) -> None:
    final = mechanics_of(0.025).given_base_angles((0.0,), (-630.0,))
    with pytest.raises(FileError):
        tubes_png(final, tmp_path / "missing" / "tubes.png")
