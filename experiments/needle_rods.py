"""Tips of tubes with a needle in them beside three rods of PyElastica, on 50 random systems.

    python -m experiments.needle_rods [COUNT]

It prints how far apart both are, in mm and degrees, and by how much the needle moves the tip.
"""

from __future__ import annotations

import sys

import numpy as np

from experiments.support.rods import apart

COUNT = 50


def main() -> None:
    """Print one line a system, then the largest of all."""
    found = apart(range(int(sys.argv[1]) if len(sys.argv) > 1 else COUNT))
    for number, each in enumerate(found):
        print(number, *(f"{value:.4f}" for value in each))
    most = np.max(found, axis=0)
    least = np.min(found, axis=0)
    print(f"{len(found)} systems: apart by {most[0]:.4f} mm and {most[1]:.4f} degrees at most")
    print(f"the needle moves tips by {least[2]:.2f} to {most[2]:.2f} mm")


if __name__ == "__main__":
    main()
