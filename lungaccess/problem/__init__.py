"""What is asked: a patient, a system of devices, a target, and the task that they make."""

from __future__ import annotations

from typing import TYPE_CHECKING

from anatomy.facade import lazy_exports

if TYPE_CHECKING:
    from lungaccess.problem.patients import load_patient as load_patient
    from lungaccess.problem.peripheral import peripheral_targets as peripheral_targets
    from lungaccess.problem.system import System as System
    from lungaccess.problem.system import load_system as load_system
    from lungaccess.problem.system import preset_names as preset_names
    from lungaccess.problem.system import system_fingerprint as system_fingerprint
    from lungaccess.problem.target import StatedTarget as StatedTarget
    from lungaccess.problem.target import Target as Target
    from lungaccess.problem.target import nodule_target as nodule_target
    from lungaccess.problem.target import point_target as point_target
    from lungaccess.problem.target import require_free as require_free
    from lungaccess.problem.target import resolve_target as resolve_target
    from lungaccess.problem.target import stated_target as stated_target
    from lungaccess.problem.task import Task as Task
    from lungaccess.problem.task import fissures_are_obstacles as fissures_are_obstacles

__getattr__, __dir__ = lazy_exports(__name__, __file__)
