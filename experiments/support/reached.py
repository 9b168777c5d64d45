"""How many peripheral targets a system reaches, kept in a file: a study that was stopped goes on."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import lungaccess as la
from anatomy.base.errors import SettingsError
from anatomy.base.files import write_text
from anatomy.lung import Lung
from experiments.support.anatomies import anatomy, default_anatomies
from experiments.support.results import Result, setting_of, study_parser, write_result
from lungaccess.planning.coupled.atlas import require_same
from lungaccess.problem.peripheral import peripheral_targets
from lungaccess.problem.system import System, system_fingerprint
from stages.needle import direct_arcs, needle_environment

TARGETS_A_LUNG, QUICK_TARGETS_A_LUNG = 50, 3


def run_study(
    doc: str | None,
    name: str,
    title: str,
    conditions: Mapping[str, str],
    systems: Callable[[], Iterable[tuple[str, System | None]]],
) -> None:
    """Count what labelled systems reach on each patient, and store the result.

    `systems` yields None for a system that breaks its own limits.
    """
    parser = study_parser(doc)
    parser.add_argument("--patients", nargs="+", default=default_anatomies())
    options = parser.parse_args()
    per_lung = QUICK_TARGETS_A_LUNG if options.quick else TARGETS_A_LUNG
    patients = options.patients[:1] if options.quick else options.patients
    setting = setting_of(options)
    result = Result(
        name=name, title=title, setting=setting, seeds=[options.seed],
        conditions={
            **conditions,
            "targets": f"{2 * per_lung} random peripheral points a patient",
            "reached": "by a single arc that is proved clear, from a deployment of the atlas",
        },
    )  # fmt: skip
    finished = FinishedCounts(Path(options.results) / setting / f"{name}_finished" / "counts.json")
    for patient in patients:
        lung = anatomy(patient)
        for label, system in systems():
            if system is None:
                result.add(f"{lung.name}: {label}", None, note="breaks its own limit of strain")
                continue
            count = finished.count(lung, system, per_lung, options.seed)
            result.add(f"{lung.name}: {label}", 100.0 * count / (2 * per_lung), unit="%")
    write_result(result, options.results)


def reached_of(atlas: la.Atlas, system: System, per_lung: int, seed: int) -> int:
    """Return how many of the peripheral targets a single arc of a system's needle reaches from an atlas."""
    lung = atlas.lung
    environment = needle_environment(lung, system.needle, system.margins, with_fissures=atlas.with_fissures)
    entries, reached = atlas.deployments, 0
    for target in peripheral_targets(lung, per_lung, seed):
        near, _ = atlas.index.holding(environment, target)
        at = (entries.positions[near], entries.tangents[near], entries.branch[near])
        blockers, _, _ = direct_arcs(environment, *at, target)
        reached += bool((blockers == 0).any())
    return reached


class FinishedCounts:
    """Counts that are kept in a file, one a lung, system, seed and number of targets."""

    def __init__(self, file: Path) -> None:
        self._file = file
        self._counts: dict[str, int] = json.loads(file.read_text()) if file.exists() else {}
        self._atlas: la.Atlas | None = None

    def count(self, lung: Lung, system: System, per_lung: int, seed: int) -> int:
        """Return the count, as kept or else made and kept."""
        key = f"{lung.key} {system_fingerprint(system)} {per_lung} {seed}"
        if key not in self._counts:
            self._counts[key] = reached_of(self._atlas_of(lung, system), system, per_lung, seed)
            self._file.parent.mkdir(parents=True, exist_ok=True)
            write_text(self._file, json.dumps(self._counts, indent=1))
        return self._counts[key]

    def _atlas_of(self, lung: Lung, system: System) -> la.Atlas:
        """Return the atlas made last if it holds for a system, which may differ in its needle."""
        try:
            if self._atlas is not None:
                require_same(self._atlas, lung, system)
                return self._atlas
        except SettingsError:
            pass
        self._atlas = la.build_atlas(lung, system)
        return self._atlas
