"""What was understood of a patient, as tables and as plain values."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.table import Table

from anatomy.base.words import percent
from anatomy.plausibility import ACCEPTED, DOUBTFUL, FITS, REFUSED
from lungaccess.cli import lazy, terminal
from lungaccess.plans.record import picked

VERDICTS = (REFUSED, ACCEPTED, DOUBTFUL, FITS)
"""In this order checks are shown: what has to be looked at comes first."""
MOTION_WORDS = {
    "landmark_pairs": "pairs of landmarks", "residual_mm": "left at the source's points, mean, mm",
    "residual_95_mm": "left at the source's points, 95 %, mm",
    "left_out_mm": "left at each half of the pairs as the other half predicts it, mean, mm",
    "left_out_95_mm": "the same, 95 %, mm",
    "to_masks_phase_mm": "left of bringing the field to the masks' phase, mm",
    "mended_share": "share of a lung in which the field slides or folds, and is continued",
    "sliding_at_pleura_mm": "difference of the field 5 mm inside and outside of the pleura, mm",
    "right_95_mm": "motion of the right lung, 95 %, mm", "left_95_mm": "motion of the left lung, 95 %, mm",
    "right_base_to_feet_mm": "base of the right lung to the feet, mean, mm",
    "left_base_to_feet_mm": "base of the left lung to the feet, mean, mm",
    "least_stretch": "proved: no length becomes shorter than this share of itself",
    "right_volume_factor": "volume of the right lung at end-inhale by that at end-exhale",
    "left_volume_factor": "volume of the left lung at end-inhale by that at end-exhale",
    "lungs_dice": "Dice of the moved lungs with other_lungs",
    "lungs_dice_unmoved": "the same of the lungs as they are",
    "lungs_borders_mm": "distance of the borders of moved and other lungs, mean, mm",
}  # fmt: skip
"""The figures of a motion in words, see `anatomy.motion`."""

if TYPE_CHECKING:
    from typing_extensions import TypeIs


def _is_lung(organ: lazy.Organ) -> TypeIs[lazy.Lung]:
    """Tell whether an organ is a lung; a liver has neither tree nor lobes."""
    return isinstance(organ, lazy.Lung)


def organ_record(lung: lazy.Organ) -> dict[str, Any]:
    """Return what was understood of a patient; a liver has neither tree nor lobes."""
    ml = lung.grid.voxel_volume_mm3 / 1000.0
    return {
        **picked(lung, "name kind key"),
        "grid": {
            "shape": list(lung.grid.shape),
            "spacing_mm": lung.grid.spacing_mm.tolist(),
            "lps_from_ijk": lung.grid.lps_from_ijk.tolist(),
        },
        "breath_hold": lung.breath_hold,
        "volumes_ml": {name: count * ml for name, count in _structure_voxels(lung).items()},
        "has_cost_map": lung.cost is not None,
        **_breathing(lung),
        "starts": len(lung.starts),
        "start_names": list(lung.start_names),
        "targets_lps": [point.tolist() for point in lung.targets_lps],
        "target_names": list(lung.target_names),
        **(_airways(lung) if _is_lung(lung) else {}),
        "nodules": [
            {
                "number": each.number,
                "is_label": each.is_label,
                **asdict(each.size),
                "diameter_mm": each.diameter_mm,
                "centre_lps": each.centre_lps.tolist(),
                **(
                    {"segment": lung.segment_at(each.centre_lps), "lobe": lung.lobe_at(each.centre_lps)}
                    if _is_lung(lung)
                    else {}
                ),
            }
            for each in lazy.nodules_of(lung)
        ],
        "sources": dict(lung.sources),
        "warnings": list(lung.warnings),
        "checks": [asdict(each) for each in lung.findings],
    }


def _checks_table(lung: lazy.Organ) -> Table:
    """Return what the checks of the masks found that is not usual, and how many found nothing."""
    ordered = sorted(lung.findings, key=lambda each: VERDICTS.index(each.verdict))
    rows = [(each.verdict, each.name, each.found) for each in ordered if each.verdict != FITS]
    if lung.findings:
        usual = len(lung.findings) - len(rows)
        rows.append((FITS, "", f"{usual} of {len(lung.findings)} figures are usual; --json lists them"))
    return terminal.table("Plausibility of the masks", ("verdict", "check", "found"), rows)


def _breathing(lung: lazy.Organ) -> dict[str, Any]:
    """Return what is known of the breathing, as plain values; nothing where nothing is."""
    motion = lung.motion if _is_lung(lung) else None
    if motion is None:
        return {}
    stated = picked(motion, "source key masks_phase amplitude hysteresis warning_only")
    return {"breathing": {**stated, **motion.figures}}


def _airways(lung: lazy.Lung) -> dict[str, Any]:
    tree, named, report = lung.tree, lung.tree.bronchi, lung.tree.report
    ml = lung.grid.voxel_volume_mm3 / 1000.0
    return {
        "lobes_ml": {name: count * ml for name, count in _lobe_voxels(lung).items()},
        "tree": {
            "branches": tree.n_branches,
            "carina_lps": tree.carina_lps.tolist(),
            "branches_by_generation": np.bincount(tree.generation).tolist(),
            "bronchi": [
                {"name": named.names[branch], "branch": branch, "confidence": float(named.confidence[branch])}
                for branch in np.flatnonzero(named.starts).tolist()
            ],
            "components_dropped": report.components_dropped,
            "voxels_dropped": report.voxels_dropped,
            "repairs": [
                {"kind": kind, "lps": each.position_lps.tolist(), "length_mm": each.length_mm}
                for kind, each in _repairs(lung)
            ],
        },
    }


def _lobe_voxels(lung: lazy.Lung) -> dict[str, int]:
    """Return how many voxels each lobe has; empty if the patient came without lobes."""
    if lung.lobes is None:
        return {}
    counts = np.bincount(lung.lobes.array.ravel(order="K"), minlength=len(lazy.LOBES) + 1)
    return {name: int(counts[number]) for number, name in lazy.LOBES.items() if counts[number]}


def _structure_voxels(lung: lazy.Organ) -> dict[str, int]:
    """Return how many voxels each structure has that is there."""
    from anatomy import structures

    counts = {
        f"inside the {'lung' if _is_lung(lung) else 'liver'}": int(
            np.count_nonzero((lung.labels & structures.OUTSIDE) == 0)
        )
    }
    for name in ("airway", "lumen", "vessel", "fissure"):
        counts[name] = int(np.count_nonzero(lung.labels & structures.BITS[name]))
    if lung.nodules is not None:
        counts["nodules"] = int(np.count_nonzero(lung.nodules.array))
    return {name: count for name, count in counts.items() if count}


def anatomy_tables(lung: lazy.Organ, *, details: bool = False) -> list[Table]:
    """Return what was understood of a patient: structures, airway tree by generation, sources.

    With `details` every repair of the airway tree has a line; they are counted else.
    """
    starts = zip(lung.start_names, (pose[:3, 3] for pose in lung.starts), strict=False)
    targets = zip(lung.target_names, lung.targets_lps, strict=False)
    places = [(name, ", ".join(f"{c:.1f}" for c in point)) for name, point in (*starts, *targets)]
    made = [
        terminal.table(f"Patient {lung.name} ({lung.kind})", ("", ""), _patient_rows(lung)),
        terminal.table("Structures", ("structure", "volume, ml", "voxels"), _volume_rows(lung)),
        _nodule_table(lung),
        _checks_table(lung),
        *(_tree_tables(lung, details) if _is_lung(lung) else ()),
        *(_motion_tables(lung) if _is_lung(lung) else ()),
        terminal.table("Starts and targets", ("name", "LPS, mm"), places),
        terminal.table(
            "Sources", ("file", "SHA-256"), [(name, digest[:16]) for name, digest in lung.sources.items()]
        ),
    ]
    return [each for each in made if each.row_count]


def _nodule_table(lung: lazy.Organ) -> Table:
    found = lazy.nodules_of(lung)
    rows = [
        (
            f"{each.number}",
            f"{each.diameter_mm:.1f}",
            f"{each.size.long_axis_mm:.1f} x {each.size.perpendicular_mm:.1f}",
            f"{each.size.volume_ml:.2f}",
            ", ".join(f"{c:.1f}" for c in each.centre_lps),
            lung.region_at(each.centre_lps) if _is_lung(lung) else "",
        )
        for each in found
    ]
    number = "label in the mask" if found and found[0].is_label else "number, by size"
    diameters = ("diameter of a ball as large, mm", "long axis x across, mm")
    headings = (number, *diameters, "volume, ml", "centre, LPS mm", "place")
    return terminal.table("Nodules, for --nodule", headings, rows)


def _tree_tables(lung: lazy.Lung, details: bool) -> list[Table]:
    tree, named = lung.tree, lung.tree.bronchi
    bronchi = [
        (
            named.names[branch],
            f"{branch}",
            f"{tree.generation[branch]}",
            f"{2.0 * tree.branch_mean_radius_mm[branch]:.1f}",
            f"{tree.branch_length_mm[branch]:.1f}",
            percent(named.confidence[branch]),
        )
        for branch in np.flatnonzero(named.starts).tolist()
    ]
    repairs = [
        (kind, ", ".join(f"{c:.1f}" for c in each.position_lps), f"{each.length_mm:.1f}")
        for kind, each in (_repairs(lung) if details else ())
    ]
    return [
        terminal.table(
            "Bronchi with a name",
            ("bronchus", "branch", "generation", "mean diameter, mm", "length, mm", "confidence"),
            bronchi,
        ),
        terminal.table(
            "Airway tree",
            ("generation", "branches", "mean radius, mm", "least radius, mm", "mean length, mm"),
            _generation_rows(lung),
        ),
        terminal.table("Repairs of the airway tree", ("repair", "at LPS, mm", "length, mm"), repairs),
    ]


def _motion_tables(lung: lazy.Lung) -> list[Table]:
    motion = lung.motion
    if motion is None:
        return []
    rows: list[terminal.Row] = [
        ("motion", motion.source),
        ("phase of the masks", f"{100.0 * motion.masks_phase:.0f} % (0 % end-exhale, 100 % end-inhale)"),
        ("amplitude", f"{100.0 * motion.amplitude:.0f} % of the source's"),
        ("hysteresis", f"{100.0 * motion.hysteresis:g} % of the distance from the scope's tip"),
        *((MOTION_WORDS.get(name, name), f"{value:.2f}") for name, value in motion.figures.items()),
    ]
    return [terminal.table("Breathing", ("", ""), rows)]


def _patient_rows(lung: lazy.Organ) -> list[terminal.Row]:
    rows: list[terminal.Row] = [("working grid", lung.grid.describe())]
    if not _is_lung(lung):
        return rows
    rows += [
        ("carina, LPS mm", ", ".join(f"{c:.1f}" for c in lung.tree.carina_lps)),
        ("breath hold", lung.breath_hold or "not stated"),
        ("fissures", _fissures(lung)),
        ("cost map", "given" if lung.cost is not None else "not given"),
        ("lobes", "given" if lung.lobes is not None else "not given"),
        ("start poses, targets", f"{len(lung.starts)}, {len(lung.targets_lps)}"),
    ]
    dropped = lung.tree.report.components_dropped
    if dropped:
        rows.append(("airway pieces left out", f"{dropped} ({lung.tree.report.voxels_dropped} voxels)"))
    kinds = Counter(kind for kind, _repair in _repairs(lung))
    if kinds:
        counted = ", ".join(f"{count} x {kind}" for kind, count in kinds.items())
        rows.append(("repairs of the airway tree", f"{counted}; --details lists them"))
    return rows


def _fissures(lung: lazy.Lung) -> str:
    """Return what is known of the fissures, in words."""
    if lung.fissure_band is None or not lung.has_fissures:
        return "known" if lung.has_fissures else "not known"
    counts = np.bincount(lung.fissure_band.array.ravel(order="K"), minlength=lazy.UNKNOWN + 1)
    ml = lung.grid.voxel_volume_mm3 / 1000.0
    rest = f"; not known in {counts[lazy.UNKNOWN] * ml:.0f} ml" if counts[lazy.UNKNOWN] else ""
    return f"within a band of {counts[1:50].sum() * ml:.0f} ml with 95 %{rest}"


def _repairs(lung: lazy.Lung) -> list[tuple[str, lazy.Repair]]:
    report = lung.tree.report
    return [
        *(("gap bridged", each) for each in report.gaps_bridged),
        *(("loop opened", each) for each in report.loops_opened),
        *(("spur pruned", each) for each in report.spurs_pruned),
        *(("piece left out beyond a gap", each) for each in report.pieces_left_out),
    ]


def _volume_rows(lung: lazy.Organ) -> list[terminal.Row]:
    ml = lung.grid.voxel_volume_mm3 / 1000.0
    counts = _structure_voxels(lung) | (_lobe_voxels(lung) if _is_lung(lung) else {})
    return [(name, f"{count * ml:.1f}", f"{count}") for name, count in counts.items()]


def _generation_rows(lung: lazy.Lung) -> list[terminal.Row]:
    tree = lung.tree
    rows: list[terminal.Row] = []
    for generation in range(int(tree.generation.max()) + 1):
        branches = np.flatnonzero(tree.generation == generation)
        radius = np.asarray(tree.branch_mean_radius_mm)[branches]
        length = np.asarray(tree.branch_length_mm)[branches]
        figures = (f"{radius.mean():.2f}", f"{radius.min():.2f}", f"{length.mean():.1f}")
        rows.append((f"{generation}", f"{len(branches)}", *figures))
    return rows
