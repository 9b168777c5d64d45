"""The choice of exits by minimum resistance [Pan2025, algorithms 1 and 2]."""

import math
from typing import Literal

import numpy as np

from anatomy.base.errors import SettingsError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float, Int
from anatomy.grid import read_only
from stages.scope.tour.kernels.circuit import all_resistances
from stages.scope.tour.subtree import Subtree

Reading = Literal["printed", "reduced"]


SAME_RESISTANCE = 1e-9
"""Relative difference up to which two resistances count as equal; sums in another order differ by less."""


@frozen_record
class Circuits:
    """The circuits of all combinations of exits; C combinations, M lesions.

    Args:
        first ((M + 1,) int64): The exits of lesion m are `first[m]` to `first[m + 1] - 1`.
        printed ((C,) float64): Resistance by the steps of section II-C and algorithm 1: resistors in as many
            loops are summed, even if they lie in different branches.
        reduced ((C,) float64): Resistance by merging layer by layer from the ends, as the last lines of
            section II-D have it: the true resistance of the tree.
    """

    first: Int
    printed: Float
    reduced: Float

    @property
    def count(self) -> int:
        """Number of combinations, C."""
        return len(self.printed)

    def distinct(self, reading: Reading = "printed") -> int:
        """Return the number of circuits with different resistances."""
        values = np.sort(self.values(reading))
        return 1 + int((np.diff(values) > SAME_RESISTANCE * values[:-1]).sum())

    def values(self, reading: Reading) -> Float:
        """Return the resistances by one of the two readings."""
        if reading not in ("printed", "reduced"):
            raise SettingsError(f"There is no reading {reading!r}", expected="printed or reduced")
        return self.printed if reading == "printed" else self.reduced

    def choice(self, reading: Reading = "printed") -> tuple[int, ...]:
        """Return the exits, one a lesion, of the circuit with the least resistance; the first of equals."""
        number = int(np.argmin(self.values(reading)))
        chosen = []
        for m in range(len(self.first) - 2, -1, -1):
            size = int(self.first[m + 1] - self.first[m])
            chosen.append(int(self.first[m]) + number % size)
            number //= size
        return tuple(chosen[::-1])


def combinations(subtree: Subtree) -> int:
    """Return the number of choices of one exit a lesion."""
    return math.prod(np.bincount(subtree.exit_lesion).tolist())


MOST_COMBINATIONS = 5_000_000
"""Every combination is computed and stored in two arrays: this many take seconds and 80 MB."""


def circuits(subtree: Subtree) -> Circuits:
    """Compute the resistances of all combinations of exits.

    Raises:
        SettingsError: If there are more than 5 million combinations.
    """
    sizes = np.bincount(subtree.exit_lesion, minlength=subtree.n_lesions)
    count = combinations(subtree)
    if count > MOST_COMBINATIONS:
        raise SettingsError(
            f"{subtree.n_lesions} lesions have {count} combinations of exits",
            expected=f"at most {MOST_COMBINATIONS} for the method of least resistance",
            remedy="Use the exact tour alone",
        )
    first = np.concatenate(((0,), np.cumsum(sizes)))
    printed, reduced = np.zeros(count), np.zeros(count)
    all_resistances(
        subtree.parent,
        subtree.resistance,
        subtree.side,
        subtree.exit_vertex,
        subtree.exit_resistance,
        first,
        printed,
        reduced,
    )
    return Circuits(first=read_only(first), printed=read_only(printed), reduced=read_only(reduced))
