"""Whether a plan is true, what it is worth, and why there is none."""

from __future__ import annotations

from typing import TYPE_CHECKING

from anatomy.base.facade import lazy_exports

if TYPE_CHECKING:
    from lungaccess.judging.presets_in_turn import (
        Attempt,
        choice_in_words,
        first_attempt,
        none_reaches,
        plan_with_presets,
    )

__getattr__, __dir__ = lazy_exports(__name__, __file__)
