"""What happened in one simulated procedure."""

from __future__ import annotations

from dataclasses import dataclass, field

from anatomy.base.typed import Float

SCOPE, TUBE, NEEDLE = "scope", "tube", "needle"
STAGES = (SCOPE, TUBE, NEEDLE)


@dataclass
class History:
    """What happened in one procedure.

    Attributes
    ----------
    chains : list of (Float, Float, int)
        Of each attempt the true scope tip `(9,)`, the true arcs `(P, 4)` of what was inserted, and how many
        of them are the tubes'.
    complete : bool
        Whether the last chain has all its devices; otherwise no path was left.
    stopped : bool
        Whether the needle stopped on its way because no path was left.
    placements : int
        How often the scope was placed.
    replans : dict of str to list of bool
        Of each stage, whether each of its replans found a path.
    corrected_mm : dict of str to list of float
        Of each stage, how far from the target the plan so far would have ended.
    """

    chains: list[tuple[Float, Float, int]] = field(default_factory=list)
    complete: bool = False
    stopped: bool = False
    placements: int = 0
    replans: dict[str, list[bool]] = field(default_factory=lambda: {stage: [] for stage in STAGES})
    corrected_mm: dict[str, list[float]] = field(default_factory=lambda: {stage: [] for stage in STAGES})
