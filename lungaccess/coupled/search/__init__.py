"""The searches for plans: over the deployment atlas, and Algorithm 1 of [Kuntz2015]."""

from lungaccess.coupled.search.atlas_search import AtlasSearch
from lungaccess.coupled.search.evaluator import NeedleDesk, Step, blocker_name
from lungaccess.coupled.search.kuntz2015 import KuntzSearch, KuntzSearchWithoutRejection

__all__ = [
    "AtlasSearch",
    "KuntzSearch",
    "KuntzSearchWithoutRejection",
    "NeedleDesk",
    "Step",
    "blocker_name",
]
