"""Which rows of the studies stand on RESULTS.md: one or a few a study, those that its question is about.

The names are those of the full setting.  Where it was not run and the quick setting has none of them, the
first row of that one stands in.
"""

from __future__ import annotations

from collections.abc import Mapping

HEADLINES: Mapping[str, tuple[str, ...]] = {
    "rosell2012": ("path, true radius, with retreats, goal reached",),
    "fu2018_cost_map": (
        "Patient1: F1, points in all voxels, best threshold",
        "Patient2: F1, points in all voxels, best threshold",
    ),
    "fu2018_needle": ("cost on the map against shortest path, median",),
    "kuntz2015_reachability": (
        "Patient1, ultrathin, fissures crossed, atlas: within 1 s",
        "Patient1, ultrathin, fissures crossed, atlas: within 20 s",
        "Patient1, flexure-needle, fissures crossed, atlas: within 20 s",
        "Patient1, ultrathin, fissures forbidden, atlas: within 20 s",
        "Patient2, ultrathin, fissures crossed, atlas: within 20 s",
        "Patient2, flexure-needle, fissures crossed, atlas: within 20 s",
        "Patient1, ultrathin, fissures crossed, Algorithm 1: within 1 s",
    ),
    "kuntz2015_quality": ("fig. 6: 15 plans to one goal", "factor that line 8 saves, all time"),
    "li2021_route": (
        "G1, exact: success, proved on the whole curve", "G1, ga: success, proved on the whole curve",
    ),
    "pan2025_tour": ("time saved, exits of least resistance, mean",),
    "alterovitz2008": ("share of simulated insertions",),
    "reachability_by_device": (
        "Patient1: scope of 3 mm, needle of 121 mm", "Patient2: scope of 3 mm, needle of 121 mm",
    ),
    "needle_planners": (
        "R = 50 mm, recorded C++ planner: solved by 1 s", "R = 50 mm, optimal: solved by 1 s",
        "R = 50 mm: queries decided",
    ),
    "tube_speed": (
        "2 tubes: equilibria a second, one call", "2 random tubes: equilibria a second, one call",
        "3 random tubes: equilibria a second, one call",
    ),
    "closed_loop": ("full errors, open loop: reached", "full errors, closed loop: reached"),
    "procedures": (
        "gated-ct, open-loop: succeed, median of the plans",
        "gated-ct, closed-loop: succeed, median of the plans",
    ),
    "success_planning": (
        "gated-ct, open-loop: success planned for, median",
        "gated-ct, measured-tip: success planned for, median",
    ),
    "rare_events": (
        "vessel, errors gated-ct x 0.11, phantom 5: estimated with weights",
        "vessel, errors gated-ct x 0.11, phantom 5: counted",
    ),
    "lobes": ("phantom 1, 0.8 mm: Dice of the worst lobe",),
    "slice_thickness": (
        "lidc-0314, slices of 3 mm: targets with a plan", "chest-cta, slices of 3 mm: targets with a plan",
    ),
    "growth": (
        "vesselness, 5 scales: CPU time at 134,217,728 voxels", "direct arcs: CPU time at 10,000 targets",
    ),
    "breathing": (
        "Patient1: targets reached in all phases, rigid plan",
        "Patient1: targets reached in all phases, window plan",
    ),
    "phantom_likeness": (
        "generation 1: length", "generation 4: inner diameter",
        "vessels 2 to 5 mm below the pleura, more than 60 mm from the carina",
        "peripheral targets within reach of thin-scope",
    ),
}  # fmt: skip

MEASURED_ON: Mapping[str, str] = {
    "coverage_by_device": "docs/measurements/coverage.md",
    "tube_designs": "docs/measurements/coverage.md",
    "decided_targets": "docs/measurements/proofs.md",
}
"""Pages that state what a study measured of which no result, or none of the full setting, is kept."""
