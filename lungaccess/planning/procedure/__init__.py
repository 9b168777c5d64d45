"""What a procedure measures and corrects on its way, and how often it then succeeds."""

from typing import TYPE_CHECKING

from anatomy.base.facade import lazy_exports

if TYPE_CHECKING:
    from lungaccess.planning.procedure.choices import Decision, Measurements
    from lungaccess.planning.procedure.insertion import WATCHED, insert_plan
    from lungaccess.planning.procedure.policy import Policy
    from lungaccess.planning.procedure.record import ProcedureRecord
    from lungaccess.planning.procedure.report import ProcedureReport
    from lungaccess.planning.procedure.simulation import simulate_procedure, simulated

__getattr__, __dir__ = lazy_exports(__name__, __file__)
