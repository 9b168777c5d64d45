"""Each stage alone, from a patient to an answer: needle, scope, tubes, route and tour."""

from typing import TYPE_CHECKING

from anatomy.base.facade import lazy_exports

if TYPE_CHECKING:
    from lungaccess.planning.one_stage.needle import (
        NeedleAnswer,
        PathSearch,
        needle_question,
        obstruction_rows,
        plan_needle,
        reason_in_words,
        search_path,
    )
    from lungaccess.planning.one_stage.replan import (
        RestOfPlan,
        ScopeReplanner,
        measured_pose,
        replan_from_scope,
        replan_from_tube,
    )
    from lungaccess.planning.one_stage.route import open_source, route_record, widest_end
    from lungaccess.planning.one_stage.scope import (
        ADVICE_FILE,
        CAMERA_FILE,
        ScopeAdvice,
        advise_scope,
        safe_scope_region,
        save_advice,
    )
    from lungaccess.planning.one_stage.tubes import (
        TubeAnswer,
        compare_sequences,
        deploy_tubes,
        design_choices,
        design_shapes,
        load_tubes,
        save_shapes,
        shapes_record,
        tubes_record,
    )

__getattr__, __dir__ = lazy_exports(__name__, __file__)
