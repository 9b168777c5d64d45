"""The fifty phantoms of `synthetic-v1`: families, seeds and traits; a released version never changes."""

from typing import Literal

from anatomy.base.errors import SettingsError
from anatomy.base.records import frozen_value
from anatomy.phantom.patient import Size
from anatomy.phantom.traits import Traits

VERSION = "synthetic-v1"
"""Name of the benchmark; other phantoms, targets, devices or rules are another version."""
Family = Literal["adult", "child", "resected", "emphysematous", "breathing"]
FAMILIES: tuple[Family, ...] = ("adult", "child", "resected", "emphysematous", "breathing")
OF_A_FAMILY = 10
SYSTEMS = ("thin-scope", "ultrathin", "therapeutic-scope")
"""The three devices: presets, as `lungaccess presets NAME` prints them."""
TARGETS_A_LUNG = 10
ADULT_MM, CHILD_MM = 1.0, 0.8
"""Edges of the voxels: those of a usual reconstruction, finer for the narrower airways of a child."""
BRONCHUS_LENGTH, VESSEL_LIMIT_MM, VESSEL_RIM_MM, HILAR_VESSEL_MM = 1.35, 0.9, 5.0, 9.0
"""Set so that the medians of a phantom come near those of two patients' masks, see the measurements."""
LOBES = ("right upper", "left upper", "right lower", "left lower", "right middle")


@frozen_value
class BenchmarkPhantom:
    """One phantom of the benchmark.

    Args:
        name: Family and number, such as "adult-01".
        number: 1 to `OF_A_FAMILY`.
        breathes: Whether the patient comes with the motion of its breath.
    """

    name: str
    family: Family
    number: int
    seed: int
    size: Size
    spacing_mm: float
    traits: Traits
    breathes: bool


def benchmark_phantoms() -> tuple[BenchmarkPhantom, ...]:
    """Return the phantoms, the first of each family first: so any beginning has all families."""
    return tuple(_phantom(family, number) for number in range(1, OF_A_FAMILY + 1) for family in FAMILIES)


def phantom_named(name: str) -> BenchmarkPhantom:
    """Return the phantom of that name.

    Raises:
        SettingsError: If there is none.
    """
    for each in benchmark_phantoms():
        if each.name == name:
            return each
    raise SettingsError(
        f"{VERSION} has no phantom {name!r}",
        expected=f"a family and a number from 01 to {OF_A_FAMILY}, families: {', '.join(FAMILIES)}",
        remedy="Name one such as adult-01",
    )


def _phantom(family: Family, number: int) -> BenchmarkPhantom:
    """Spread the traits evenly over the numbers, each in another order, so that no two go together."""
    child = family == "child"
    traits = Traits(
        stature=_spread(0.95, 1.13, number, 3),
        flow_exponent=_spread(1.9, 2.1, number, 7),
        vessel_calibre=_spread(1.3, 1.7, number, 1),
        bronchus_length=BRONCHUS_LENGTH,
        vessel_limit_mm=VESSEL_LIMIT_MM,
        vessel_rim_mm=VESSEL_RIM_MM,
        hilar_vessel_mm=HILAR_VESSEL_MM,
        # These shares of the fissures are open in turn: every second phantom has complete ones.
        open_fissures=(0.0, 0.45)[number % 2],
        resected=LOBES[(number - 1) % len(LOBES)] if family == "resected" else "",
        emphysema=_spread(0.3, 1.0, number, 9) if family == "emphysematous" else 0.0,
    )
    return BenchmarkPhantom(
        name=f"{family}-{number:02d}",
        family=family,
        number=number,
        # Seeds run on from here, so that no phantom of the tests or of the documentation is among them.
        seed=28_000 + 100 * FAMILIES.index(family) + number,
        size="small" if child else "adult",
        spacing_mm=CHILD_MM if child else ADULT_MM,
        traits=traits,
        breathes=family == "breathing",
    )


def _spread(low: float, high: float, number: int, stride: int) -> float:
    """Return one of ten evenly spaced values; a stride without a common factor with 10 meets each once."""
    return round(low + (high - low) * ((number * stride) % OF_A_FAMILY) / (OF_A_FAMILY - 1), 4)
