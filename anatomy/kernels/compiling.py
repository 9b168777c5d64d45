"""How kernels are compiled that only other kernels call."""

from __future__ import annotations

import numba

inner_kernel = numba.njit(cache=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
"""Compile a function without the entrances that calls from Python would need: that takes less time."""

borrowing_kernel = numba.njit(cache=True, no_cpython_wrapper=True, no_cfunc_wrapper=True, _nrt=False)
"""Compile such a function to borrow its arrays, which it must not make or keep: counting who else holds them
takes longer than a look at a field, and twice as long where two threads count."""

inlined_kernel = numba.njit(cache=True, forceinline=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
"""Compile such a function, small, into every kernel that calls it.

A call that passes a tuple of arrays counts references to each of them: within the 121 candidates of a motion
of the scope that costs as much as the motion itself.
"""

merged_kernel = numba.njit(cache=True, inline="always")
"""Compile such a function as a part of its one caller.

Apart, it would be optimised again in each kernel above.  Not for one that asks whether an argument is None,
nor for one whose result chooses between kinds of arguments: that is not decided while types are found.
"""
