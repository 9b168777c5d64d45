"""Search a device by successive halving over the targets of a cohort [Jamieson2016]."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from anatomy.base.errors import SettingsError
from anatomy.base.files import require_writable_folder, write_json, write_text
from anatomy.base.records import frozen_value
from anatomy.base.settings import override, settings_toml
from lungaccess.problem.system import System, load_system, with_fissure_rule
from lungaccess.running.design.settings import CRITERIA, Contender, Design, device, near, value_at
from lungaccess.running.study.driver import Progress, RunMaker, open_results
from lungaccess.running.study.runs import Run, beside, runs_of
from lungaccess.running.study.settings import StudyError

_OUTCOME = """
SELECT r.correct_solution, 1.0 * json_extract(p.plan, '$.chance.successes')
    / json_extract(p.plan, '$.chance.samples')
FROM runs r LEFT JOIN plans p ON p.runid = r.id WHERE r.key = ?"""


@frozen_value
class DesignFound:
    """What a search found.

    Args:
        counted: The devices that were tried on every target, the one that the search began with first.
        front: Those of them that no other surpasses; the first has most of the first criterion.
        tried: Devices that were tried on some targets.
        refused (mapping of str to (int, str)): How many the validator of devices refused, and its words, by
            the key that it objects to.
    """

    design: Design
    counted: tuple[Contender, ...]
    front: tuple[Contender, ...]
    tried: int
    refused: dict[str, tuple[int, str]]

    @property
    def criteria(self) -> list[str]:
        """Titles of what was made large."""
        return [CRITERIA[name].title for name in self.design.make_large]

    def record(self) -> dict[str, Any]:
        """Return it as plain values."""
        keys = [key for number in self.design.vary for key in number.keys]
        plain = {
            each.system.name: {
                "numbers": {key: value_at(each.system, key) for key in keys},
                "reached": sum(each.reached),
                "targets": len(each.reached),
                "values": dict(zip(self.criteria, each.values, strict=True)),
            }
            for each in self.counted
        }
        front = [each.system.name for each in self.front]
        return {
            "best": front[0],
            "front": front,
            "devices": plain,
            "tried": self.tried,
            "refused": self.refused,
        }


def run_design(
    design: Design,
    folder: Path,
    *,
    scheduler: str | None = None,
    workers: int | None = None,
    cache: Path | None = None,
    progress: Progress | None = None,
) -> DesignFound:
    """Search a device; write `design.json`, the best as `device.toml`, and the front into a folder.

    The files of the front are numbered in its order, from the best.

    Every run is kept in the folder's `results.db`: a search that was stopped goes on from there.  The same
    search finds the same, whatever ended it on the way and however many workers it has.  Parameters and
    errors are those of `lungaccess.running.study.driver.run_study`, and moreover:

    Raises:
        SettingsError: If the validator refuses every device.
        StudyError: If a run could not be made.
    """
    front = require_writable_folder(Path(folder) / "front")
    say = progress or (lambda _words, _share: None)
    file = front.parent / "results.db"
    with open_results(file, scheduler=scheduler, workers=workers, cache=cache) as maker:
        runs = list(runs_of(design.study, cache=cache, progress=lambda words: say(words, None)))
        found = _Search(design, runs, maker, say).run()
    write_json(front.parent / "design.json", found.record())
    write_text(front.parent / "device.toml", settings_toml(found.front[0].system))
    for old in front.glob("[0-9]*.toml"):
        old.unlink()  # An edited search may have a shorter front.
    for number, each in enumerate(found.front, start=1):
        write_text(front / f"{number}.toml", settings_toml(each.system))
    return found


class _Search:
    def __init__(self, design: Design, runs: Sequence[Run], maker: RunMaker, say: Progress) -> None:
        from scipy.stats.qmc import Sobol

        self._design, self._maker, self._say = design, maker, say
        # Case by case: the first rung counts few patients, of whom each costs an atlas of every device.
        order = np.random.default_rng(design.seed).permutation(len(runs))
        cases = list(dict.fromkeys(run.problem.case for run in runs))
        self._cohort = sorted((runs[n] for n in order), key=lambda run: cases.index(run.problem.case))
        self._base = load_system(beside(design.study.case[0].system, Path(design.study.folder)))
        self._even = Sobol(len(design.vary), seed=design.seed)
        self._known, self._refused = set[str](), dict[str, tuple[int, str]]()
        # Keys and criteria that the device does not have are refused before any run.
        there = {key: value_at(self._base, key) for number in design.vary for key in number.keys}
        override(self._base, there, "design.vary")
        self._values(Contender(system=self._base, reached=(False,), chances=(0.0,)))

    def run(self) -> DesignFound:
        counted = list[Contender]()
        for number in range(self._design.rounds):
            # Impossible ranges show when devices are drawn, before anything is counted.
            drawn = self._drawn(number, counted)
            if not counted:
                base = Contender(system=self._base)
                counted = self._counted([base], len(self._cohort), "the device as it is")
            counted += self._halved(drawn, f"round {number + 1}") if drawn else []
        best = sorted(front_of(counted), key=lambda each: each.values, reverse=True)
        return DesignFound(
            design=self._design,
            counted=tuple(counted),
            front=tuple({each.values: each for each in reversed(best)}.values())[::-1],
            tried=len(self._known),
            refused=self._refused,
        )

    def _drawn(self, number: int, counted: Sequence[Contender]) -> list[Contender]:
        """Return the devices of a round: anywhere in the ranges first, then nearer and nearer to the best."""
        design, found = self._design, list[Contender]()
        centres = chosen(counted, min(len(counted), math.ceil(design.designs / design.reduction)))
        # For one device so many may be refused: a round in narrow limits ends, with fewer devices.
        for _ in range(64 * design.designs):
            point = self._even.random(1)[0].tolist()
            if number:
                point = near(centres[len(found) % len(centres)].system, design.vary, point, 0.5**number)
            try:
                system = device(self._base, design.vary, point)
            except SettingsError as error:
                words = error.found.removeprefix("the device: ")
                count, first = self._refused.get(words.split(" = ")[0], (0, f"{words}; {error.expected}"))
                self._refused[words.split(" = ")[0]] = (count + 1, first)
                continue
            if system.name not in self._known:
                self._known.add(system.name)
                found.append(Contender(system=system))
            if len(found) == design.designs:
                break
        if not self._known:
            raise SettingsError(
                "No device within the ranges is possible: " + "; ".join(f for _, f in self._refused.values()),
                expected="ranges in which the validator of devices accepts some",
                remedy="Correct [design.vary], or let a number vary that the refused one depends on",
            )
        return found

    def _halved(self, drawn: list[Contender], what: str) -> list[Contender]:
        """Return the devices that are left when all targets are counted."""
        reduction, least = self._design.reduction, len(self._design.make_large)
        kept, sizes = [len(drawn)], [len(self._cohort)]
        while kept[-1] // reduction >= least and sizes[-1] > 1:
            kept.append(math.ceil(kept[-1] / reduction))
            sizes.append(math.ceil(sizes[-1] / reduction))
        for left, size in zip(kept[1:], reversed(sizes[1:]), strict=True):
            drawn = chosen(self._counted(drawn, size, what), left)
        return self._counted(drawn, sizes[0], what)

    def _counted(self, devices: Sequence[Contender], targets: int, what: str) -> list[Contender]:
        """Return the devices with what became of the first targets."""
        runs = [[_with(run, each.system) for run in self._cohort[:targets]] for each in devices]
        words = f"{what}, {len(devices)} devices, {targets} targets"
        done = self._maker.make(sum(runs, []), lambda said, share: self._say(f"{words}: {said}", share))
        if done.failed or done.other_kernels:
            raise StudyError(
                f"{words}: of {done.runs} runs {done.failed} could not be made, and other kernels made "
                f"{done.other_kernels}",
                expected="an answer of every run by the same kernels: the search depends on all of them",
                remedy="`lungaccess study export` shows why. Start it again: it goes on from what is stored; "
                "for the kernels here, name another folder",
            )
        counted = []
        for each, own in zip(devices, runs, strict=True):
            rows = [next(self._maker.results.rows(_OUTCOME, (run.key,))) for run in own]
            chances = tuple((chance or 0.0) if accepted else 0.0 for accepted, chance in rows)
            made = replace(each, reached=tuple(bool(accepted) for accepted, _ in rows), chances=chances)
            counted.append(replace(made, values=self._values(made)))
        return counted

    def _values(self, contender: Contender) -> tuple[float, ...]:
        return tuple(CRITERIA[name].value(contender) for name in self._design.make_large)


def _with(run: Run, system: System) -> Run:
    """Return a run with another device, and the rule of its case for fissures."""
    ruled = with_fissure_rule(system, run.problem.system.fissures_allowed)
    return replace(run, problem=replace(run.problem, system=ruled))


def front_of(found: Sequence[Contender]) -> list[Contender]:
    """Return those that no other one surpasses: it would have as much of all criteria and more of one."""
    values = np.array([each.values for each in found])
    surpassed = [((values >= own).all(axis=1) & (values > own).any(axis=1)).any() for own in values]
    return [each for each, is_so in zip(found, surpassed, strict=True) if not is_so]


def chosen(found: Sequence[Contender], number: int) -> list[Contender]:
    """Return the best ones: each has least of the largest weighted shortfall, for another weight.

    The weights lead evenly from the first criterion alone to the second alone (Chebyshev's scalarisation).
    """
    if not found:
        return []
    values = np.array([each.values for each in found])
    span = np.ptp(values, axis=0)
    short = (values.max(axis=0) - values) / np.where(span > 0.0, span, 1.0)
    left, order = list(range(len(found))), list[Contender]()
    for share in np.linspace(1.0, 0.0, number):
        weights = np.array([share, 1.0 - share]) if values.shape[1] == 2 else np.ones(1)
        best = min(left, key=lambda n: (float((weights * short[n]).max()), float(short[n].sum()), n))
        left.remove(best)
        order.append(found[best])
    return order
