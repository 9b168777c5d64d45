"""The record of a procedure: what was measured and decided, which can be written, read and played again."""

import hashlib
import json
import os
from pathlib import Path
from typing import Any

from anatomy.base.errors import PlanFileError
from anatomy.base.files import read_text, write_text
from anatomy.base.settings import parse, to_mapping
from anatomy.lung import Lung
from lungaccess.planning.procedure.choices import Decision, Measurements
from lungaccess.planning.procedure.policy import Policy
from lungaccess.plans.file import to_json
from lungaccess.plans.plan import Plan
from lungaccess.problem.errors import ErrorModel
from lungaccess.problem.procedures import Procedure


class ProcedureRecord:
    """What was measured and decided in one procedure, in its order.

    Attributes:
        steps: Of each step what was measured and what was decided, plain JSON values.
    """

    def __init__(self, policy: Policy) -> None:
        self.policy = policy
        self.steps: list[dict[str, Any]] = []

    def decide(self, measured: Measurements) -> Decision:
        """Return what the policy decides, and note it; errors as `Policy.decide`."""
        decision = self.policy.decide(measured)
        # A step is noted as it is read again from JSON.
        step = {"measured": measured.record(), "decided": decision.record()}
        self.steps.append(json.loads(json.dumps(step)))
        return decision

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the record as JSON; FileError if that is impossible."""
        policy = self.policy
        content = {
            "plan_sha256": _plan_digest(policy.plan), "errors": to_mapping(policy.errors),
            "procedure": to_mapping(policy.procedure), "radius_mm": policy.assessor.radius_mm,
            "steps": self.steps,
        }  # fmt: skip
        write_text(os.fspath(path), json.dumps(content, indent=1))

    @classmethod
    def load(cls, path: str | os.PathLike[str], plan: Plan, lung: Lung) -> "ProcedureRecord":
        """Read a record of the procedure of a plan, and play it again.

        Raises:
            FileError: If the file cannot be read.
            PlanFileError: If it is no record, one of another plan, or the same measurements lead to other
                decisions.
        """
        try:
            stored = json.loads(read_text(Path(path)))
            digest, steps, radius_mm = stored["plan_sha256"], stored["steps"], stored["radius_mm"]
            measured = [Measurements(**_tuples(each["measured"])) for each in steps]
            errors = parse(ErrorModel, stored["errors"], os.fspath(path))
            procedure = parse(Procedure, stored["procedure"], os.fspath(path))
        except (ValueError, KeyError, TypeError) as reason:
            raise PlanFileError(
                f"{os.fspath(path)} is no record of a procedure",
                expected="what `lungaccess replan --record` writes",
            ) from reason
        if digest != _plan_digest(plan):
            raise PlanFileError(
                f"{os.fspath(path)} is the record of another plan",
                expected="the plan that the procedure carried out",
            )
        record = cls(Policy(plan, lung, errors, procedure, radius_mm=radius_mm))
        for number, each in enumerate(measured):
            record.decide(each)
            if record.steps[-1] != steps[number]:
                raise PlanFileError(
                    f"Step {number + 1} of {os.fspath(path)} is decided otherwise when it is played again",
                    expected="the software that wrote the record",
                )
        return record


def _plan_digest(plan: Plan) -> str:
    """Return the SHA-256 of a plan as it is written."""
    return hashlib.sha256(to_json(plan).encode()).hexdigest()


def _tuples(value: Any) -> Any:
    """Return plain JSON values with tuples in place of lists."""
    if isinstance(value, list):
        return tuple(_tuples(each) for each in value)
    return {name: _tuples(each) for name, each in value.items()} if isinstance(value, dict) else value
