"""What is asked: a patient, a system of devices, a target, and the task that they make."""

from typing import TYPE_CHECKING

from anatomy.base.facade import lazy_exports

if TYPE_CHECKING:
    from lungaccess.problem.patients import load_organ, load_patient
    from lungaccess.problem.peripheral import peripheral_targets
    from lungaccess.problem.preset_order import presets_by_invasiveness
    from lungaccess.problem.system import System, load_system, preset_names, shipped_names
    from lungaccess.problem.target import Place, Target, describe_place, point_target, resolve_target
    from lungaccess.problem.task import fissures_are_obstacles

__getattr__, __dir__ = lazy_exports(__name__, __file__)
