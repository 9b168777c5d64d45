"""Numbers that options take, each with the range in which it makes sense."""

import math
import operator
from collections.abc import Sequence
from typing import Annotated

from cyclopts import Parameter, Token

from anatomy.base.records import frozen_value

MOST = 10**9
"""A larger count of anything would run for years."""
MOST_SAMPLES = 10_000_000
"""Their random numbers fit into memory, and shares are then known to 0.03 %."""
LEAST = 1e-9
"""No length, speed or time above nothing is smaller; what is divides to more than numbers hold."""
ONE_TURN_DEG = 360.0
"""A tube that is turned farther comes back to where it was."""
FARTHEST_MM = 1e4
"""No length in a patient comes near ten metres; larger numbers are slips."""


@frozen_value
class Within:
    """Refuses a number outside a range; ends are inclusive but for `above` and `below`, None is open."""

    above: float | None = None
    at_least: float | None = None
    below: float | None = None
    at_most: float | None = None

    def __call__(self, kind: object, value: float | None) -> None:
        """Raise ValueError, whose text says what is allowed, if a value lies outside."""
        ends = (
            ("above", self.above, operator.gt), ("at least", self.at_least, operator.ge),
            ("below", self.below, operator.lt), ("at most", self.at_most, operator.le),
        )  # fmt: skip
        stated = [(word, end, holds) for word, end, holds in ends if end is not None]
        kept = value is not None and all(holds(value, end) for _word, end, holds in stated)
        if value is None or (kept and math.isfinite(value) and not 0.0 < abs(value) < LEAST):
            return
        noun = "a whole number" if isinstance(value, int) else "a finite number"
        raise ValueError(
            f"{noun} {' and '.join(f'{word} {end:.10g}' for word, end, _holds in stated)}".strip()
        )


def whole(kind: object, tokens: Sequence[Token]) -> int:
    """Read a whole number; one with decimals is refused, not rounded."""
    return int(tokens[0].value)


Whole = Annotated[int, Parameter(converter=whole)]
# Compiled kernels take seeds of 32 bits.
Seed = Annotated[Whole, Parameter(validator=Within(at_least=0, at_most=2**32 - 1))]
Count = Annotated[Whole, Parameter(validator=Within(at_least=1, at_most=MOST))]
CountOrNone = Annotated[Whole, Parameter(validator=Within(at_least=0, at_most=MOST))]
# No machine that these commands run on has as many cores.
Processes = Annotated[Whole, Parameter(validator=Within(at_least=1, at_most=1024))]
Samples = Annotated[Whole, Parameter(validator=Within(at_least=1, at_most=MOST_SAMPLES))]
SamplesOrNone = Annotated[Whole, Parameter(validator=Within(at_least=0, at_most=MOST_SAMPLES))]
# TCP has no larger one.
Port = Annotated[Whole, Parameter(validator=Within(at_least=0, at_most=2**16 - 1))]
# No tracker and no robot in a patient needs more.
Hertz = Annotated[float, Parameter(validator=Within(above=0.0, at_most=1000.0))]
Spacing = Annotated[float, Parameter(validator=Within(at_least=0.5, at_most=50.0))]
# No command runs for three years.
Seconds = Annotated[float, Parameter(validator=Within(above=0.0, at_most=1e8))]
Positive = Annotated[float, Parameter(validator=Within(above=0.0, at_most=FARTHEST_MM))]
NotNegative = Annotated[float, Parameter(validator=Within(at_least=0.0, at_most=FARTHEST_MM))]
Angle = Annotated[float, Parameter(validator=Within(at_least=-ONE_TURN_DEG, at_most=ONE_TURN_DEG))]
Probability = Annotated[float, Parameter(validator=Within(above=0.0, below=1.0))]
