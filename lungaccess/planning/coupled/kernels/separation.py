"""Compiled kernel of diverse plan sets: it chooses lines of which every two are separated."""

from __future__ import annotations

from anatomy.kernels.compiling import inner_kernel, kernel


@inner_kernel
def _strays(one, other, square):
    """Tell whether some point of a line is `square` mm^2 or more, squared, from all points of another."""
    for m in range(one.shape[0]):
        near = False
        for n in range(other.shape[0]):
            dx = one[m, 0] - other[n, 0]
            dy = one[m, 1] - other[n, 1]
            dz = one[m, 2] - other[n, 2]
            if dx * dx + dy * dy + dz * dz < square:
                near = True
                break
        if not near:
            return True
    return False


@kernel(nogil=True)
def choose_separated(lines, order, separation_mm, chosen):
    """Choose lines one after the other, each separated from all chosen before.

    Two lines are separated if some point of either is `separation_mm` or more from all points of the other.

    Parameters
    ----------
    lines : (N, M, 3) float64, mm
    order : (K,) int64
        Which lines to look at, the best first.
    separation_mm : float
    chosen : (C,) int64
        Receives at most C of them.

    Returns
    -------
    int
        How many were chosen.
    """
    square = separation_mm * separation_mm
    count = 0
    for n in order:
        if count == chosen.shape[0]:
            break
        separated = True
        for m in range(count):
            one, other = lines[n], lines[chosen[m]]
            if not (_strays(one, other, square) or _strays(other, one, square)):
                separated = False
                break
        if separated:
            chosen[count] = n
            count += 1
    return count
