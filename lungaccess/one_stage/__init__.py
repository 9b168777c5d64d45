"""Each stage alone, from a patient to an answer: needle, scope, tubes, route and tour."""

from __future__ import annotations

from typing import TYPE_CHECKING

from anatomy.facade import lazy_exports

if TYPE_CHECKING:
    from lungaccess.one_stage.needle import OMPL_PLANNERS as OMPL_PLANNERS
    from lungaccess.one_stage.needle import OMPL_TOLERANCE_MM as OMPL_TOLERANCE_MM
    from lungaccess.one_stage.needle import NeedleAnswer as NeedleAnswer
    from lungaccess.one_stage.needle import pierced_branch as pierced_branch
    from lungaccess.one_stage.needle import plan_needle as plan_needle
    from lungaccess.one_stage.route import RouteSource as RouteSource
    from lungaccess.one_stage.route import open_source as open_source
    from lungaccess.one_stage.route import read_drawing as read_drawing
    from lungaccess.one_stage.route import route_record as route_record
    from lungaccess.one_stage.route import widest_end as widest_end
    from lungaccess.one_stage.scope import ADVICE_FILE as ADVICE_FILE
    from lungaccess.one_stage.scope import CAMERA_FILE as CAMERA_FILE
    from lungaccess.one_stage.scope import ScopeAdvice as ScopeAdvice
    from lungaccess.one_stage.scope import advise_scope as advise_scope
    from lungaccess.one_stage.scope import save_advice as save_advice
    from lungaccess.one_stage.tour import TourAnswer as TourAnswer
    from lungaccess.one_stage.tour import coupled_plan_test as coupled_plan_test
    from lungaccess.one_stage.tour import plan_tour as plan_tour
    from lungaccess.one_stage.tour import read_lesions as read_lesions
    from lungaccess.one_stage.tour import tour_record as tour_record
    from lungaccess.one_stage.tubes import TubeAnswer as TubeAnswer
    from lungaccess.one_stage.tubes import TubePair as TubePair
    from lungaccess.one_stage.tubes import compare_sequences as compare_sequences
    from lungaccess.one_stage.tubes import deploy_tubes as deploy_tubes
    from lungaccess.one_stage.tubes import design_choices as design_choices
    from lungaccess.one_stage.tubes import load_tubes as load_tubes
    from lungaccess.one_stage.tubes import tubes_record as tubes_record

__getattr__, __dir__ = lazy_exports(__name__, __file__)
