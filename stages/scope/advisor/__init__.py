"""The bronchoscope advisor [Rosell2012]: motions from wherever the scope is, and paths to a goal."""

from __future__ import annotations

from typing import TYPE_CHECKING

from anatomy.facade import lazy_exports

if TYPE_CHECKING:
    from stages.scope.advisor.advisor import Advice as Advice
    from stages.scope.advisor.advisor import Advisor as Advisor
    from stages.scope.advisor.advisor import ThinnerScope as ThinnerScope
    from stages.scope.advisor.advisor import start_state as start_state
    from stages.scope.advisor.advisor import why_stopped as why_stopped
    from stages.scope.advisor.best_motion import Candidates as Candidates
    from stages.scope.advisor.best_motion import Motion as Motion
    from stages.scope.advisor.best_motion import MotionEvaluation as MotionEvaluation
    from stages.scope.advisor.best_motion import Weights as Weights
    from stages.scope.advisor.best_motion import evaluate_motions as evaluate_motions
    from stages.scope.advisor.environment import ScopeEnvironment as ScopeEnvironment
    from stages.scope.advisor.fly_through import MARKUPS_SCHEMA as MARKUPS_SCHEMA
    from stages.scope.advisor.fly_through import FlyThrough as FlyThrough
    from stages.scope.advisor.fly_through import camera_flight as camera_flight
    from stages.scope.advisor.instructions import Instruction as Instruction
    from stages.scope.advisor.instructions import instructions_along as instructions_along
    from stages.scope.advisor.kinematics import ScopeModel as ScopeModel
    from stages.scope.advisor.kinematics import ScopeState as ScopeState
    from stages.scope.advisor.kinematics import advanced as advanced
    from stages.scope.advisor.kinematics import joints as joints
    from stages.scope.advisor.kinematics import model_of as model_of
    from stages.scope.advisor.kinematics import straight_state as straight_state
    from stages.scope.advisor.kinematics import tip_frames as tip_frames
    from stages.scope.advisor.kinematics import tool_frames as tool_frames
    from stages.scope.advisor.lumen import Lumen as Lumen
    from stages.scope.advisor.lumen import lumen_of_lung as lumen_of_lung
    from stages.scope.advisor.lumen import lumen_of_mask as lumen_of_mask
    from stages.scope.advisor.nf1 import Goal as Goal
    from stages.scope.advisor.nf1 import NavigationField as NavigationField
    from stages.scope.advisor.nf1 import goal_at as goal_at
    from stages.scope.advisor.nf1 import navigation_field as navigation_field
    from stages.scope.advisor.orientability import Orientability as Orientability
    from stages.scope.advisor.orientability import measure_orientability as measure_orientability
    from stages.scope.advisor.path import ScopePath as ScopePath
    from stages.scope.advisor.path_search import PathSearch as PathSearch
    from stages.scope.advisor.path_search import PathSettings as PathSettings
    from stages.scope.advisor.session import Session as Session

__getattr__, __dir__ = lazy_exports(__name__, __file__)
