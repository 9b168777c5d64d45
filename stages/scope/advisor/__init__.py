"""The bronchoscope advisor [Rosell2012]: motions from wherever the scope is, and paths to a goal."""

from typing import TYPE_CHECKING

from anatomy.base.facade import lazy_exports

if TYPE_CHECKING:
    from stages.scope.advisor.advisor import (
        Advice,
        Advisor,
        PathSettings,
        ThinnerScope,
        start_state,
        why_stopped,
    )
    from stages.scope.advisor.best_motion import Candidates, Motion, MotionEvaluation, Weights
    from stages.scope.advisor.kinematics import ScopeModel, ScopeState, model_of
    from stages.scope.advisor.lumen import Lumen, lumen_of_lung
    from stages.scope.advisor.nf1 import Goal, NavigationField, goal_at
    from stages.scope.advisor.path import (
        MARKUPS_SCHEMA,
        FlyThrough,
        Instruction,
        ScopePath,
        camera_flight,
        instructions_along,
    )

__getattr__, __dir__ = lazy_exports(__name__, __file__)
