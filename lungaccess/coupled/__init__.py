"""The coupled planner: it searches for plans of all three stages, diverse plan sets, and counterfactuals."""

from __future__ import annotations

from typing import TYPE_CHECKING

from anatomy.facade import lazy_exports

if TYPE_CHECKING:
    from lungaccess.coupled.atlas import Atlas as Atlas
    from lungaccess.coupled.atlas import build_atlas as build_atlas
    from lungaccess.coupled.atlas_measures import tip_clearances_mm as tip_clearances_mm
    from lungaccess.coupled.atlas_measures import tube_stability as tube_stability
    from lungaccess.coupled.atlas_store import open_atlas as open_atlas
    from lungaccess.coupled.counterfactuals import Counterfactual as Counterfactual
    from lungaccess.coupled.counterfactuals import find_counterfactuals as find_counterfactuals
    from lungaccess.coupled.diverse_plans import Alternative as Alternative
    from lungaccess.coupled.diverse_plans import alternatives as alternatives
    from lungaccess.coupled.diverse_plans import criteria as criteria
    from lungaccess.coupled.diverse_plans import with_front as with_front
    from lungaccess.coupled.explanation import explain as explain
    from lungaccess.coupled.kuntz2015_fcl.search import ReferenceSearch as ReferenceSearch
    from lungaccess.coupled.planner import METHODS as METHODS
    from lungaccess.coupled.planner import ProgressEvent as ProgressEvent
    from lungaccess.coupled.planner import atlas_event as atlas_event
    from lungaccess.coupled.planner import plan as plan
    from lungaccess.coupled.search.atlas_search import AtlasSearch as AtlasSearch
    from lungaccess.coupled.search.base import Incumbent as Incumbent
    from lungaccess.coupled.search.base import ParallelSearch as ParallelSearch
    from lungaccess.coupled.search.base import PlanSearch as PlanSearch
    from lungaccess.coupled.search.base import Step as Step
    from lungaccess.coupled.search.base import evaluated_step as evaluated_step
    from lungaccess.coupled.search.direct_arcs import DirectArcs as DirectArcs
    from lungaccess.coupled.search.kuntz2015 import KuntzSearch as KuntzSearch
    from lungaccess.coupled.search.settings import SearchSettings as SearchSettings

__getattr__, __dir__ = lazy_exports(__name__, __file__)
