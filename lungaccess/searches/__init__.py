"""The searches for plans: over the deployment atlas, and Algorithm 1 of [Kuntz2015]."""

from lungaccess.searches.atlas_search import AtlasSearch
from lungaccess.searches.desk import NeedleDesk, Step, blocker_name
from lungaccess.searches.kuntz import KuntzSearch, KuntzSearchWithoutRejection

__all__ = [
    "AtlasSearch",
    "KuntzSearch",
    "KuntzSearchWithoutRejection",
    "NeedleDesk",
    "Step",
    "blocker_name",
]
