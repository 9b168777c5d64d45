"""How kernels are compiled: by numba, their machine code kept on disk and bound to all of its sources."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba

from anatomy.machine_code.cache import KernelCache
from anatomy.machine_code.target import choose_processor

choose_processor(numba)


def kernel(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator that compiles a function when it is first called, or finds its machine code on disk.

    Parameters
    ----------
    **options
        Options of `numba.njit`, such as ``nogil=True``.
    """

    def compiled(function: Callable[..., Any]) -> Any:
        dispatcher = numba.njit(**options)(function)
        if dispatcher is not function:  # numba hands back the function itself under NUMBA_DISABLE_JIT.
            dispatcher._cache = KernelCache(function)
        return dispatcher

    return compiled


inner_kernel = kernel(no_cpython_wrapper=True, no_cfunc_wrapper=True)
"""Compile a function without the entrances that calls from Python would need: that takes less time."""

borrowing_kernel = kernel(no_cpython_wrapper=True, no_cfunc_wrapper=True, _nrt=False)
"""Compile such a function to borrow its arrays, which it must not make or keep: counting who else holds them
takes longer than a look at a field, and twice as long where two threads count."""

inlined_kernel = kernel(forceinline=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
"""Compile such a function, small, into every kernel that calls it.

A call that passes a tuple of arrays counts references to each of them: within the 121 candidates of a motion
of the scope that costs as much as the motion itself.
"""

merged_kernel = kernel(inline="always")
"""Compile such a function as a part of its one caller.

Apart, it would be optimised again in each kernel above.  Not for one that asks whether an argument is None,
nor for one whose result chooses between kinds of arguments: that is not decided while types are found.
"""
