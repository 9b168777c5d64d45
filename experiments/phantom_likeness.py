"""How like patients the phantoms of the benchmark synthetic-v1 are: branches, vessels, clearance and reach.

    python -m experiments.phantom_likeness [--quick] [--results FOLDER]

Each phantom is written to files and read again, and each lung is measured after it was prepared: so phantoms
and patients go through the same steps.  The patients are those below LUNGACCESS_DATA that have masks.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

import lungaccess as la
from anatomy.base.records import frozen_value
from anatomy.lung import Lung
from anatomy.phantom import write_phantom
from experiments.support.anatomies import PATIENTS, require_data
from experiments.support.likeness import DEPTHS_MM, FAR_MM, GENERATIONS, Likeness, likeness_of
from experiments.support.reached import reached_of
from experiments.support.results import Result, number, setting_of, study_parser, write_result
from lungaccess.running.benchmark.synthetic.cases import (
    FAMILIES,
    BenchmarkPhantom,
    make_benchmark_phantom,
    phantom_named,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MEASURED_PATIENTS = {
    **{name: f"med-rad/{name}" for name in PATIENTS},
    "at expiration": "med-rad-respiratory/Patient2",
}
"""Two at inspiration and one at expiration: names in the picture, and places below the data."""
OF_A_FAMILY, QUICK_OF_A_FAMILY = 3, 1
CHILD = "child"
SYSTEM = "thin-scope"
TARGETS_A_LUNG = 25
SHOWN_GENERATIONS = GENERATIONS[:6]


@frozen_value
class Measured:
    """The likeness of a lung, its family ("" for a patient), and what a device reaches in it, per cent."""

    likeness: Likeness
    family: str
    reached: float

    def numbers(self) -> dict[str, float]:
        """Return all that is compared, by the words of the table with their unit."""
        like = self.likeness
        found = {"volume of the lungs, l": like.lung_l, "branches": float(like.branches)}
        for words, by_generation in (
            ("length, mm", like.length_mm),
            ("inner diameter, mm", like.diameter_mm),
            ("angle to the parent branch, degrees", like.angle_deg),
        ):
            for generation in SHOWN_GENERATIONS:
                quartiles = by_generation[generation]
                if quartiles:
                    found[f"generation {generation}: {words}"] = quartiles[1]
        for where, shares in (
            ("", like.vessel_share),
            (f", more than {FAR_MM:g} mm from the carina", like.far_vessel_share),
        ):
            for (low, high), share in zip(DEPTHS_MM, shares, strict=True):
                found[f"vessels {low:g} to {high:g} mm below the pleura{where}, %"] = 100.0 * share
        return found | {
            "clearance of free tissue, mm": like.clearance_mm[1],
            f"peripheral targets within reach of {SYSTEM}, %": self.reached,
        }


def measured(lung: Lung, name: str, family: str, seed: int) -> Measured:
    """Measure a lung, and call it by that name."""
    print(f"measuring {name}", flush=True)
    system = la.load_system(SYSTEM)
    reached = reached_of(la.build_atlas(lung, system), system, TARGETS_A_LUNG, seed)
    like = replace(likeness_of(lung), name=name)
    return Measured(likeness=like, family=family, reached=100.0 * reached / (2 * TARGETS_A_LUNG))


def phantoms(of_a_family: int) -> Iterator[BenchmarkPhantom]:
    """Yield the first phantoms of every family."""
    for family in FAMILIES:
        for n in range(1, of_a_family + 1):
            yield phantom_named(f"{family}-{n:02d}")


def phantom_lung(case: BenchmarkPhantom) -> Lung:
    """Return the lung of a phantom as everybody reads it: from files."""
    from anatomy.build import build_lung
    from anatomy.io import load_patient

    with tempfile.TemporaryDirectory() as folder:
        write_phantom(make_benchmark_phantom(case), Path(folder), with_ct=False)
        return build_lung(load_patient(folder))


def add_rows(result: Result, patients: Sequence[Measured], made: Sequence[Measured]) -> None:
    """Add a row a number: the median of the grown-up phantoms, beside that of the patients."""
    grown = [each for each in made if each.family != CHILD]
    children = [each for each in made if each.family == CHILD]
    for words in grown[0].numbers():
        groups = [_known(words, group) for group in (patients, grown, children)]
        medians = [float(np.median(each)) if each else None for each in groups]
        notes = [
            "patients " + ", ".join(number(each) for each in groups[0]) if groups[0] else "",
            f"phantoms {number(min(groups[1]))} to {number(max(groups[1]))}" if groups[1] else "",
            f"children {number(medians[2])}",
        ]
        quantity, _comma, unit = words.rpartition(", ")
        quantity, unit = (quantity, unit) if quantity else (words, "")
        result.add(quantity, medians[1], medians[0], unit, "; ".join(note for note in notes if note))


def _known(words: str, group: Sequence[Measured]) -> list[float]:
    return [numbers[words] for numbers in (each.numbers() for each in group) if words in numbers]


def draw(patients: Sequence[Measured], made: Sequence[Measured]) -> Figure:
    """Draw patients as lines and the phantoms of each family as a band from the least to the largest."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure: Figure
    figure, panels = plt.subplots(2, 2, figsize=(9.0, 6.6))
    families = [each.family for each in made]
    for panel, (title, along, line) in zip(panels.flat, _lines(), strict=True):
        _bands(panel, along, np.array([line(each.likeness) for each in made]), families)
        for style, each in zip(("-", "--", ":"), patients, strict=False):
            panel.plot(along, line(each.likeness), color="black", linestyle=style, label=each.likeness.name)
        panel.set_title(title, fontsize=10)
        panel.grid(visible=True, alpha=0.3)
    for panel in panels.flat[:3]:
        panel.set_xlabel("generation")
    panels[1, 1].set_xlabel("distance to the pleura, mm")
    panels[0, 0].legend(fontsize=7)
    figure.tight_layout()
    return figure


def _bands(panel: Axes, along: np.ndarray, values: np.ndarray, families: Sequence[str]) -> None:
    for nth, family in enumerate(FAMILIES):
        own = values[[each == family for each in families]]
        low, middle, high = (np.nanquantile(own, q, axis=0) for q in (0.0, 0.5, 1.0))
        panel.fill_between(along, low, high, color=f"C{nth}", alpha=0.15, linewidth=0)
        panel.plot(along, middle, color=f"C{nth}", linewidth=1, label=family)


def _lines() -> list[tuple[str, np.ndarray, Callable[[Likeness], list[float]]]]:
    """Return what the panels show: title, values along the axis, and a lung's line."""
    generations = np.array(SHOWN_GENERATIONS, dtype=float)
    depths = np.array([0.5 * (low + high) for low, high in DEPTHS_MM])
    return [
        ("length, mm", generations, lambda like: _by_generation(like.length_mm)),
        ("inner diameter, mm", generations, lambda like: _by_generation(like.diameter_mm)),
        ("angle to the parent branch, degrees", generations, lambda like: _by_generation(like.angle_deg)),
        (
            f"vessels, % of lung, more than {FAR_MM:g} mm from the carina",
            depths,
            lambda like: [100.0 * share for share in like.far_vessel_share],
        ),
    ]


def _by_generation(quartiles: dict[int, tuple[float, ...]]) -> list[float]:
    return [quartiles[g][1] if quartiles[g] else float("nan") for g in SHOWN_GENERATIONS]


def main() -> None:
    """Measure all lungs and store the result."""
    options = study_parser(__doc__).parse_args()
    of_a_family = QUICK_OF_A_FAMILY if options.quick else OF_A_FAMILY
    result = Result(
        name="phantom_likeness", title="How like patients the phantoms of synthetic-v1 are",
        source="the median of the patients, in the column `paper`", setting=setting_of(options),
        seeds=[options.seed],
        conditions={
            "patients": "two segmented lungs at inspiration, one at expiration",
            "phantoms": f"the first {of_a_family} of every family",
            "ours": "median of the phantoms without the children",
            "length": "median of the branches that end in a fork; diameter and angle: of all branches",
            "reach": f"{2 * TARGETS_A_LUNG} random peripheral targets, by a single arc that is proved clear",
        },
    )  # fmt: skip
    patients = [
        measured(la.load_patient(require_data(part)), name, "", options.seed)
        for name, part in MEASURED_PATIENTS.items()
    ]
    made = [
        measured(phantom_lung(case), case.name, case.family, options.seed) for case in phantoms(of_a_family)
    ]
    add_rows(result, patients, made)
    result.figure = draw(patients, made)
    print(write_result(result, options.results))


if __name__ == "__main__":
    main()
