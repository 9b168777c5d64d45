"""How kernels are compiled that only other kernels call."""

from __future__ import annotations

import numba

inner_kernel = numba.njit(cache=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
"""Compile a function without the entrances that calls from Python would need: that takes less time."""

borrowing_kernel = numba.njit(cache=True, no_cpython_wrapper=True, no_cfunc_wrapper=True, _nrt=False)
"""Compile such a function to borrow its arrays, which it must not make or keep: counting who else holds them
takes longer than a look at a field, and twice as long where two threads count."""
