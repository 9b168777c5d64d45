"""An explanation as plain values, and as files."""

import os
from pathlib import Path
from typing import Any

from anatomy.base.files import write_json
from anatomy.base.typed import Float
from anatomy.io.frames import LPS_FROM_RAS
from lungaccess.judging.answering import Attempt
from lungaccess.judging.explanation.blocking import ArcBeyondLimits, BlockedArc, Blocking, Structure
from lungaccess.judging.explanation.explanation import Change, Explanation
from lungaccess.judging.explanation.neighbours import ReachedShare
from lungaccess.plans.version import made_by
from lungaccess.uncertainty.risk import Share

Record = dict[str, Any]
FILE = "no_plan.json"


def save_explanation(explanation: Explanation, folder: str | os.PathLike[str]) -> tuple[str, ...]:
    """Write `no_plan.json` and the plans to a folder that exists, and return the names of the files.

    Raises:
        FileError: If a file cannot be written.
    """
    for name, plan in explanation.plans.items():
        plan.save(Path(folder) / name)
    write_json(Path(folder) / FILE, explanation_record(explanation))
    return (FILE, *explanation.plans)


def explanation_record(explanation: Explanation) -> Record:
    """Return an explanation as plain values: lengths in mm, points in LPS and RAS mm."""
    e = explanation
    return {
        **made_by(),
        "found": False,
        "accepted": False,
        "headline": e.headline,
        "advice": e.advice,
        "why": e.failure.found,
        "patient": e.patient_name,
        "system": e.system.name,
        "fissures_are_obstacles": e.with_fissures,
        "target": {**point(e.target.lps_mm), "origin": e.target.origin},
        "reasons": dict(e.failure.reasons),
        "attempts": dict(e.failure.attempts),
        "starts": None if e.starts is None else dict(e.starts.counts),
        "blocking": [_blocking(each) for each in e.blocking],
        "nearest_miss": {
            "path_to_the_target": None
            if e.blocked_arc is None
            else {**_numbers(e.blocked_arc), **_structure(e.blocked_arc.structure)},
            "path_beyond_the_limits": None if e.arc_beyond_limits is None else _numbers(e.arc_beyond_limits),
            "nearest_point_reached": _neighbour(e),
        },
        "presets": [
            {"system": name, "tried": False} if attempt is None else _attempt(e, attempt)
            for name, attempt in e.presets.items()
        ],
        "changes": [_change(e, each) for each in e.changes],
        "through_fissures": e.through_fissures,
        "reached_shares": [_share(each) for each in e.shares],
        "proved_unreachable": None if e.verdict is None else e.verdict.proved,
        "radial_ultrasound": e.ultrasound or None,
        "proof_rests_on": "" if e.verdict is None else e.verdict.rests_on,
        "parts": [{"part": part.name, "outcome": part.outcome, "why": part.why} for part in e.parts],
        "chances_under_default_errors": {name: _chance(share) for name, share in e.chances.items()},
        "files": list(e.plans),
        "explain_cpu_s": e.time_s,
    }


def point(lps_mm: Float) -> Record:
    """Return a point (3,) LPS mm in both frames."""
    ras = LPS_FROM_RAS[:3, :3] @ lps_mm
    return {"lps_mm": [float(c) for c in lps_mm], "ras_mm": [float(c) for c in ras]}


def _structure(structure: Structure) -> Record:
    return {
        "structure": structure.kind,
        "name": structure.name,
        **point(structure.lps_mm),
        "from_target_mm": structure.from_target_mm,
    }


def _numbers(arc: BlockedArc | ArcBeyondLimits) -> Record:
    return {name: value for name, value in vars(arc).items() if isinstance(value, int | float)}


def _blocking(blocking: Blocking) -> Record:
    return {
        **_structure(blocking.place),
        "arcs": blocking.arcs,
        "arcs_at_place": blocking.arcs_at_place,
        "of_arcs": blocking.of,
    }


def _neighbour(e: Explanation) -> Record | None:
    neighbour = e.neighbour
    if neighbour is None:
        return None
    return {
        **point(neighbour.plan.target_lps),
        "from_target_mm": neighbour.from_target_mm,
        "plan": e.file_of(neighbour.plan),
    }


def _chance(share: Share) -> Record:
    return {"succeeds": share.value, "interval": list(share.interval), "procedures": share.samples}


def _attempt(e: Explanation, attempt: Attempt) -> Record:
    return {
        "system": attempt.system.name,
        "tried": True,
        "found": attempt.succeeded,
        "why": attempt.why,
        "plan": e.file_of(attempt.plan),
    }


def _change(e: Explanation, change: Change) -> Record:
    return {
        "change": str(change.change),
        "parameter": change.change.parameter,
        "present_mm": change.change.present,
        "needed_mm": change.change.needed,
        "accepted": change.accepted,
        "plan": e.file_of(change.change.plan),
    }


def _share(share: ReachedShare) -> Record:
    return {
        "region": share.region,
        "reached": share.share.count,
        "of": share.share.samples,
        "interval": list(share.share.interval),
    }
