"""Compares answers of compiled kernels with those of their sources in plain Python, and with the truth.

`python -m lungaccess.judging.selftest.run KIND ...` is the process that answers in plain Python: with
NUMBA_DISABLE_JIT=1 the sources of the kernels run as they are, and numpy tests every index of an array.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from anatomy.base.child_process import end_with_parent
from anatomy.base.errors import SettingsError
from anatomy.base.records import frozen_value
from lungaccess.judging.selftest.kinds import KINDS

TOLERANCE = 1e-9
"""Relative, or in mm and rad.  Arithmetic is done in the same order, but `hypot` and others may differ in
their last digit, and a proof goes on from what it has computed."""
PACKAGES = Path(__file__).resolve().parents[3]


@frozen_value
class Failure:
    """What is wrong in the case of a seed, with the numbers that contradict each other."""

    seed: int
    said: str


@frozen_value
class Outcome:
    """What became of the cases of one kind.

    Parameters
    ----------
    differences : tuple of Failure
        Cases in which compiled kernels and plain Python differ; None if kernels were not compiled here.
    contradictions : tuple of Failure
        Cases in which the answers contradict the truth.
    seconds : float
        For the compiled answers and the truth.
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
    """Compute proofs of every kind on drawn cases, compiled and in plain Python, and compare with the truth.

    Where NUMBA_DISABLE_JIT is set nothing is compiled, and the truth alone is compared.

    Parameters
    ----------
    kinds : sequence of str
        Names of `KINDS`; all of them if empty.
    progress : callable, optional
        Told the kind that is computed now.

    Raises
    ------
    SettingsError
        If there is no such kind.
    """
    import numba

    names = list(dict.fromkeys(kinds or KINDS))
    for name in names:
        if name not in KINDS:
            raise SettingsError(f"There is no kind of proof named {name!r}", expected=", ".join(KINDS))
    if numba.config.DISABLE_JIT:
        return tuple(_outcome(name, *_answered(name), None) for name in map(_reported(progress), names))
    with _plain(names) as plain:
        found = {name: _answered(name) for name in map(_reported(progress), names)}
        progress("the same in plain Python")
        answers = plain()
    return tuple(_outcome(name, *found[name], answers[name]) for name in names)


Answers = dict[int, Any]
"""The answers to cases by their seeds: numbers, or an error in words."""


def _reported(progress: Callable[[str], None]) -> Callable[[str], str]:
    def tell(name: str) -> str:
        progress(name)
        return name

    return tell


def _answered(name: str) -> tuple[Answers, tuple[Failure, ...], float]:
    """Return the compiled answers, what contradicts the truth, and the time for both."""
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
    return answers, tuple(contradictions), time.perf_counter() - begun


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


def _outcome(
    name: str, compiled: Answers, contradictions: tuple[Failure, ...], seconds: float, plain: Answers | None
) -> Outcome:
    pairs = [] if plain is None else [(seed, _difference(compiled[seed], plain[seed])) for seed in compiled]
    return Outcome(
        kind=name,
        proves=KINDS[name].proves,
        cases=len(compiled),
        differences=None if plain is None else tuple(Failure(seed=s, said=said) for s, said in pairs if said),
        contradictions=contradictions,
        seconds=seconds,
    )


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


def _print_answers(names: list[str]) -> None:
    """Print as JSON, by kind and seed, the numbers or an error in words."""
    end_with_parent()
    found = {name: {str(seed): _plain_answer(name, seed) for seed in KINDS[name].seeds} for name in names}
    json.dump(found, sys.stdout)


def _plain_answer(name: str, seed: int) -> Any:
    try:
        return KINDS[name].case(seed).answers.tolist()
    except Exception as error:  # Whatever a broken kernel does is a result.
        return f"{type(error).__name__}: {error}"


if __name__ == "__main__":
    _print_answers(sys.argv[1:])
