"""What is asked: a patient, a system of devices, a target, and the task that they make."""

from __future__ import annotations

from typing import TYPE_CHECKING

from anatomy.base.facade import lazy_exports

if TYPE_CHECKING:
    from lungaccess.problem.patients import load_organ, load_patient
    from lungaccess.problem.peripheral import peripheral_targets
    from lungaccess.problem.place import Place, describe_place
    from lungaccess.problem.preset_order import (
        Invasiveness,
        invasiveness,
        least_invasive_first,
        presets_by_invasiveness,
    )
    from lungaccess.problem.system import (
        System,
        load_system,
        needle_preset_names,
        preset_names,
        shipped_names,
        system_fingerprint,
        tube_preset_names,
    )
    from lungaccess.problem.target import (
        StatedTarget,
        Target,
        nodule_target,
        point_target,
        require_free,
        resolve_target,
        stated_target,
    )
    from lungaccess.problem.task import Task, fissures_are_obstacles, objective_of

__getattr__, __dir__ = lazy_exports(__name__, __file__)
