"""Compares answers of compiled kernels with those of their sources in plain Python, and with the truth.

`python -m lungaccess.judging.selftest.run KIND ...` is the process that answers in plain Python: with
NUMBA_DISABLE_JIT=1 the sources of the kernels run as they are, and numpy tests every index of an array.
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from anatomy.base.child_process import end_with_parent
from anatomy.base.errors import SettingsError
from anatomy.base.records import frozen_value
from lungaccess.judging.selftest import deployment_cases, motion_cases, needle_cases
from lungaccess.judging.selftest.scenes import Case

TOLERANCE = 1e-9
"""Relative, or in mm and rad.  Arithmetic is done in the same order, but `hypot` and others may differ in
their last digit, and a proof goes on from what it has computed."""
PACKAGES = Path(__file__).resolve().parents[3]


class Kind(NamedTuple):
    """One kind of proof, and seeds of cases in which bounds are close to the truth and Python is quick."""

    proves: str
    draw: Callable[[np.random.Generator], Case]
    seeds: tuple[int, ...]

    def case(self, seed: int) -> Case:
        """Return the case of a seed, answered."""
        return self.draw(np.random.default_rng(seed))


KINDS: Mapping[str, Kind] = {
    "distances": Kind(
        "a clearance bound is below the distance, by a diagonal of a voxel at most",
        needle_cases.distances, (0, 1, 2, 3),
    ),
    "arcs": Kind(
        "a path of the needle keeps its clearance, or does not", needle_cases.arcs, (0, 1, 2, 3, 4)
    ),
    "tubes": Kind(
        "tubes keep clear of all but the wall that they pierce",
        deployment_cases.tubes, (0, 1, 2, 3, 4, 5, 6, 7),
    ),
    "scope motions": Kind(
        "a motion of the scope touches no wall, at and between its states", motion_cases.motions, (3, 4, 6)
    ),
    "start region": Kind(
        "the needle reaches its target from every start of the region", needle_cases.start_region, (1, 2, 3)
    ),
    "no path": Kind("no path of the needle leads to a target", needle_cases.no_path, (1, 3, 5, 11, 14)),
    "cost bound": Kind(
        "no path from a range of deployments costs less", deployment_cases.cost_bound, (0, 1, 2, 3)
    ),
    "unreachable": Kind(
        "no deployment of a range reaches a target", deployment_cases.not_reached, (2, 3, 4, 7)
    ),
    "window": Kind(
        "devices are clear and on target in all phases of a stretch of the breath, or in none",
        motion_cases.windows, (1, 4, 7),
    ),
}  # fmt: skip
"""The kinds by name."""


@frozen_value
class Failure:
    """What is wrong in the case of a seed, with the numbers that contradict each other."""

    seed: int
    said: str


@frozen_value
class Outcome:
    """What became of the cases of one kind: where kernels and plain Python differ, and contradictions.

    There are no differences, but None, if kernels were not compiled here.
    """

    kind: str
    proves: str
    cases: int
    differences: tuple[Failure, ...] | None
    contradictions: tuple[Failure, ...]
    seconds: float

    @property
    def held(self) -> bool:
        """Whether all agrees."""
        return not self.differences and not self.contradictions


def self_test(
    kinds: Sequence[str] = (), *, progress: Callable[[str], None] = lambda _kind: None
) -> tuple[Outcome, ...]:
    """Compute proofs of the named kinds, or all, compiled and in plain Python, and compare with the truth.

    Where NUMBA_DISABLE_JIT is set nothing is compiled, and the truth alone is compared.  SettingsError is
    raised if there is no such kind.
    """
    import numba

    names = list(dict.fromkeys(kinds or KINDS))
    for name in names:
        if name not in KINDS:
            raise SettingsError(
                f"There is no kind of proof named {name!r}",
                expected=", ".join(KINDS),
                remedy="Name one of these, or none to test all",
            )
    found = []
    with nullcontext() if numba.config.DISABLE_JIT else _plain(names) as plain:
        for name in names:
            progress(name)
            found.append(_answered(name))
        if plain is None:
            return tuple(outcome for outcome, _answers in found)
        progress("the same in plain Python")
        there = plain()
    return tuple(
        replace(outcome, differences=_differences(answers, there[outcome.kind])) for outcome, answers in found
    )


Answers = dict[int, Any]
"""The answers to cases by their seeds: numbers, or an error in words."""


def _answered(name: str) -> tuple[Outcome, Answers]:
    """Compare the compiled answers with the truth, and return them, too."""
    begun, contradictions = time.perf_counter(), []
    answers: Answers = {}
    for seed in KINDS[name].seeds:
        try:
            case = KINDS[name].case(seed)
            answers[seed], said = case.answers, case.contradiction()
        except Exception as error:  # Whatever a broken kernel does is a result.
            said = answers[seed] = f"{type(error).__name__}: {error}"
        if said:
            contradictions.append(Failure(seed=seed, said=said))
    outcome = Outcome(
        kind=name,
        proves=KINDS[name].proves,
        cases=len(answers),
        differences=None,
        contradictions=tuple(contradictions),
        seconds=time.perf_counter() - begun,
    )
    return outcome, answers


@contextmanager
def _plain(names: list[str]) -> Iterator[Callable[[], dict[str, Answers]]]:
    """Let another process answer in plain Python meanwhile; what is given waits for its answers."""
    path = os.pathsep.join(filter(None, [str(PACKAGES), os.environ.get("PYTHONPATH")]))
    with subprocess.Popen(
        [sys.executable, "-m", "lungaccess.judging.selftest.run", *names],
        env={**os.environ, "NUMBA_DISABLE_JIT": "1", "PYTHONPATH": path},
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    ) as process:  # fmt: skip

        def answers() -> dict[str, Answers]:
            said, errors = process.communicate()
            if process.returncode:
                last = (errors.strip().splitlines() or ["no word"])[-1]
                wrong = f"the process ended with {process.returncode}: {last}"
                return {name: dict.fromkeys(KINDS[name].seeds, wrong) for name in names}
            found = json.loads(said)
            return {name: {int(seed): each for seed, each in found[name].items()} for name in names}

        try:
            yield answers
        finally:
            process.kill()


def _differences(compiled: Answers, plain: Answers) -> tuple[Failure, ...]:
    said = {seed: _difference(compiled[seed], plain[seed]) for seed in compiled}
    return tuple(Failure(seed=seed, said=words) for seed, words in said.items() if words)


def _difference(compiled: Any, plain: Any) -> str:
    """Say where compiled and plain answers differ first, "" if they do not."""
    if isinstance(compiled, str) or isinstance(plain, str):
        same = isinstance(compiled, str) and compiled == plain
        return "" if same else f"compiled {_short(compiled)}, in Python {_short(plain)}"
    there = np.array(plain, dtype=np.float64)
    if compiled.shape != there.shape:
        return f"compiled {len(compiled)} numbers, in Python {len(there)}"
    far = ~np.isclose(compiled, there, rtol=TOLERANCE, atol=TOLERANCE, equal_nan=True)
    n = int(np.argmax(far))
    return f"number {n}: compiled {float(compiled[n])!r}, in Python {float(there[n])!r}" if far.any() else ""


def _short(answers: Any) -> str:
    return answers if isinstance(answers, str) else f"{len(answers)} numbers"


def _plain_answer(name: str, seed: int) -> Any:
    try:
        return KINDS[name].case(seed).answers.tolist()
    except Exception as error:  # Whatever a broken kernel does is a result.
        return f"{type(error).__name__}: {error}"


if __name__ == "__main__":
    end_with_parent()
    json.dump(
        {name: {str(seed): _plain_answer(name, seed) for seed in KINDS[name].seeds} for name in sys.argv[1:]},
        sys.stdout,
    )
