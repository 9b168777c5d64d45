"""Results as plain values, for commands that print JSON."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from anatomy.lung import Lung
    from anatomy.tree_report import GapBridged, LoopOpened, SpurPruned
    from lungaccess.checking import CheckReport
    from lungaccess.plans.no_plan import NoPlan
    from lungaccess.plans.plan import Plan


def plan_record(plan: Plan, report: CheckReport, folder: Path, files: tuple[str, ...]) -> dict[str, Any]:
    """Return what a command that planned found and wrote; lengths in mm, times in s."""
    return {
        "found": True,
        "accepted": report.accepted,
        "refusals": [each.to_mapping() for each in report.refusals],
        "folder": str(folder),
        "files": list(files),
        "digest": plan.digest,
        "objective": plan.objective,
        "cost": plan.cost,
        "costs": dict(plan.costs),
        "clearance_mm": {device: dict(values) for device, values in plan.clearance_mm.items()},
        "iterations": plan.iterations,
        "timing": dict(plan.timing),
    }


def no_plan_record(failure: NoPlan) -> dict[str, Any]:
    """Return why there is no plan."""
    return {
        "found": False,
        "accepted": False,
        "why": failure.found,
        "reasons": dict(failure.reasons),
        "advice": failure.advice,
    }


def lung_record(lung: Lung) -> dict[str, Any]:
    """Return what was understood of a patient."""
    tree, report = lung.tree, lung.tree.report
    ml = lung.grid.voxel_volume_mm3 / 1000.0
    repairs: dict[str, tuple[GapBridged | LoopOpened | SpurPruned, ...]] = {
        "gap bridged": report.gaps_bridged,
        "loop opened": report.loops_opened,
        "spur pruned": report.spurs_pruned,
    }
    return {
        "name": lung.name,
        "kind": lung.kind,
        "key": lung.key,
        "grid": {
            "shape": list(lung.grid.shape),
            "spacing_mm": lung.grid.spacing_mm.tolist(),
            "lps_from_ijk": lung.grid.lps_from_ijk.tolist(),
        },
        "breath_hold": lung.breath_hold,
        "volumes_ml": {name: count * ml for name, count in structure_voxels(lung).items()},
        "has_cost_map": lung.cost is not None,
        "starts": len(lung.starts),
        "targets_lps": [point.tolist() for point in lung.targets_lps],
        "tree": {
            "branches": tree.n_branches,
            "carina_lps": tree.carina_lps.tolist(),
            "branches_by_generation": np.bincount(tree.generation).tolist(),
            "components_dropped": report.components_dropped,
            "voxels_dropped": report.voxels_dropped,
            "repairs": [
                {"kind": kind, "lps": each.position_lps.tolist(), "length_mm": each.length_mm}
                for kind, records in repairs.items()
                for each in records
            ],
        },
        "sources": dict(lung.sources),
        "warnings": list(lung.warnings),
    }


def structure_voxels(lung: Lung) -> dict[str, int]:
    """Return how many voxels each structure has that is there."""
    from anatomy import structures

    counts = {"inside the lung": int(np.count_nonzero((lung.labels & structures.OUTSIDE) == 0))}
    for name in ("airway", "lumen", "vessel", "fissure"):
        counts[name] = int(np.count_nonzero(lung.labels & structures.BITS[name]))
    if lung.nodules is not None:
        counts["nodules"] = int(np.count_nonzero(lung.nodules.array))
    return {name: count for name, count in counts.items() if count}
