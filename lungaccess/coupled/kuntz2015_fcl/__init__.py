"""Reference mode: Algorithm 1 of [Kuntz2015] as printed, a slow yardstick that knows no clearance fields."""

from lungaccess.coupled.kuntz2015_fcl.search import ReferenceSearch, ReferenceSearchWithoutRejection, Refusal

__all__ = ["ReferenceSearch", "ReferenceSearchWithoutRejection", "Refusal"]
