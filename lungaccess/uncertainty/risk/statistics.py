"""Shares of samples and their confidence."""

import math

import numpy as np

from anatomy.base.records import frozen_value
from anatomy.base.typed import Bool

Z_95 = 1.959963984540054
"""Two-sided 95 % quantile of the normal distribution."""


@frozen_value
class Share:
    """How many of a number of samples, and what that says of the probability."""

    count: int
    samples: int

    @property
    def value(self) -> float:
        """The share."""
        return self.count / self.samples

    @property
    def interval(self) -> tuple[float, float]:
        """The 95 % confidence interval of [Wilson1927]."""
        share, z2 = self.value, Z_95 * Z_95
        middle = (share + 0.5 * z2 / self.samples) / (1.0 + z2 / self.samples)
        half = Z_95 * math.sqrt(share * (1.0 - share) / self.samples + 0.25 * z2 / self.samples**2)
        half /= 1.0 + z2 / self.samples
        return max(middle - half, 0.0), min(middle + half, 1.0)

    def to_mapping(self) -> dict[str, object]:
        """Return plain JSON values."""
        return {"probability": self.value, "interval_95": list(self.interval)}


def share_of(hits: Bool) -> Share:
    """Return the share of the samples `(N,)` that are true."""
    return Share(count=int(np.count_nonzero(hits)), samples=len(hits))
