"""`NoPlan`: the answer when there is no plan, with the reasons counted."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING

from anatomy.base.errors import LungaccessError

if TYPE_CHECKING:
    from lungaccess.plans.plan import Plan


class NoPlan(LungaccessError):  # noqa: N818
    """No plan was found; says why, stage by stage.

    Args:
        found: One sentence: what prevents a plan.
        reasons: How many sites, deployments or needle paths each reason ruled out.
        main_reason: What prevents a plan, without the length of the search; `found` if it is not stated.
        advice: The smallest change of device that would make the target reachable, if one was found.
        counterfactuals: For each change of one device parameter that makes the target reachable, a plan with
            that change.
        attempts: Where several systems were tried: why each failed, by its name, in the order in which they
            were tried.
    """

    def __init__(
        self,
        found: str,
        *,
        reasons: Mapping[str, int],
        main_reason: str = "",
        advice: str = "",
        counterfactuals: "Mapping[str, Plan] | None" = None,
        attempts: Mapping[str, str] | None = None,
    ) -> None:
        self.counterfactuals: Mapping[str, Plan] = MappingProxyType(dict(counterfactuals or {}))
        self.attempts: Mapping[str, str] = MappingProxyType(dict(attempts or {}))
        self.reasons: Mapping[str, int] = MappingProxyType(dict(reasons))
        self.main_reason = main_reason or found
        self.advice = advice
        super().__init__(found, remedy=advice)
