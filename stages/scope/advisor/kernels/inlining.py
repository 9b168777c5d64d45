"""How the small kernels of the scope are compiled: into their callers.

A call that passes a tuple of arrays counts references to each of them; within the 121 candidates of a
motion that costs as much as the motion itself.
"""

from __future__ import annotations

import numba

inlined_kernel = numba.njit(cache=True, forceinline=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
"""Compile a function into every kernel that calls it."""
