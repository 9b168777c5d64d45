"""The processor for which kernels are compiled: one that all machines of its kind can follow."""

from __future__ import annotations

import platform
from typing import Any

PROCESSORS = {"x86_64": "x86-64-v2", "amd64": "x86-64-v2", "arm64": "generic", "aarch64": "generic"}
"""LLVM's names by those that Python has for machines.

All x86-64 processors since 2009 follow the second level.  Kernels gain nothing from later instructions:
118,000 shapes of two tubes a second with the second level, the third, and those of the machine itself.
"""


def choose_processor(numba: Any) -> None:
    """Let numba compile for every machine of this kind, so that what it made can be taken to another.

    A choice by ``NUMBA_CPU_NAME`` stands.  Where numba has already made code, for another library, it goes on
    as it began: its code for this machine is then compiled here, and kept apart.
    """
    begun = "_toplevel_target_context" in vars(numba.core.registry.cpu_target)
    name = PROCESSORS.get(platform.machine().lower())
    if name is not None and numba.config.CPU_NAME is None and not begun:
        numba.config.CPU_NAME, numba.config.CPU_FEATURES = name, ""
