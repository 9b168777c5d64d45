"""An explanation in words, for the terminal and the page alike, and as plain values and files."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from anatomy.base.files import write_json
from anatomy.base.records import frozen_value
from anatomy.base.typed import Float
from anatomy.base.words import of_hundred, percent, point_in_words
from anatomy.io.frames import LPS_FROM_RAS
from lungaccess.judging.answering import Attempt
from lungaccess.judging.explanation.blocking import ArcBeyondLimits, BlockedArc, Structure
from lungaccess.judging.explanation.explanation import Change, Explanation
from lungaccess.plans.record import picked
from lungaccess.plans.version import made_by

Row = tuple[str, ...]


@frozen_value
class Section:
    """A table: its title, the headings of its columns, its rows."""

    title: str
    headings: tuple[str, ...]
    rows: tuple[Row, ...]


def sections(explanation: Explanation) -> tuple[Section, ...]:
    """Return the sections of an explanation that have something to say, the most useful first."""
    e = explanation
    made = (
        Section(title="What would reach it", headings=("what", "how", "plan"), rows=tuple(_helps(e))),
        Section(title="Nearest miss", headings=("what", "how near", "where"), rows=tuple(_misses(e))),
        Section(
            title="What blocks the direct arcs within the needle's limits",
            headings=("structure", "arcs that it stops first", "where most of them are stopped"),
            rows=tuple(_blocks(e)),
        ),
        Section(
            title=f"Other presets, the least invasive first: {len(e.attempts)} of {len(e.presets)} tried",
            headings=("preset", "outcome", "plan"),
            rows=tuple(_presets(e)),
        ),
        Section(
            title="Where the needle can start, and why each start fails",
            headings=("starts", "count"),
            rows=() if e.starts is None else tuple((why, str(n)) for why, n in e.starts.counts.items() if n),
        ),
        Section(
            title=f"What {_by(e)} nearby",
            headings=("where", "how much"),
            rows=tuple((share.region, share.words) for share in e.shares),
        ),
        Section(title="Proof", headings=("question", "answer"), rows=tuple(_proof(e))),
        Section(
            title="Not tried: nothing follows from these",
            headings=("what", "why"),
            rows=tuple((part.name, part.why) for part in e.not_tried),
        ),
    )
    return tuple(section for section in made if section.rows)


def _helps(e: Explanation) -> Iterator[Row]:
    for attempt in e.attempts:
        if attempt.succeeded:
            name = _file(e, attempt.plan)
            yield f"preset {attempt.system.name}", _accepted(e, name), name
    for each in e.changes:
        name = _file(e, each.change.plan)
        yield str(each.change), _accepted(e, name) if name else "a plan that the check REFUSES", name
    if e.through_fissures:
        how = "a single arc, at the price of piercing the pleura twice; not planned, not checked"
        yield "crossing a fissure (--allow-fissures)", how, ""


def _accepted(e: Explanation, name: str) -> str:
    """Say that the check accepts a plan, and how often it succeeds: one without the other says too much."""
    chance = e.chances.get(name)
    how_often = "chance of success not estimated"
    if chance is not None:
        how_often = f"succeeds in {of_hundred(chance.value)} of 100 procedures under the default errors"
    return f"a plan that the check accepts; {how_often}"


def _by(e: Explanation) -> str:
    """Return what reaches the points around a target, with its verb."""
    return "aimed tubes reach" if e.system.needle is None else "a single arc reaches"


def _misses(e: Explanation) -> Iterator[Row]:
    arc, beyond, neighbour = e.blocked_arc, e.arc_beyond_limits, e.neighbour
    if arc is not None:
        yield "path to the target that violates least", arc.violation, str(arc.structure)
    if beyond is not None:
        yield "path to the target that exceeds the needle's limits least", beyond.needs, "obstacles ignored"
    if neighbour is not None:
        near = f"ends {neighbour.from_target_mm:.1f} mm from the target; {_file(e, neighbour.plan)}"
        yield f"nearest point found that {_by(e)}", near, point_in_words(neighbour.plan.target_lps)
    if e.ultrasound:
        yield "radial ultrasound", e.ultrasound, ""


def _blocks(e: Explanation) -> Iterator[Row]:
    for each in e.blocking:
        spot, near = each.place, f"{each.arcs_at_place} within 5 mm of {point_in_words(each.place.lps_mm)}"
        yield (
            f"{spot.kind} {spot.name}",
            f"{each.arcs} of {each.of} ({percent(each.arcs / each.of)})",
            f"{near}, {spot.from_target_mm:.1f} mm from the target",
        )


def _presets(e: Explanation) -> Iterator[Row]:
    for name, attempt in e.presets.items():
        yield (name, "not tried", "") if attempt is None else (name, attempt.why, _file(e, attempt.plan))


def _proof(e: Explanation) -> Iterator[Row]:
    if e.verdict is None:
        return
    if e.verdict.proved:
        answer = (
            f"yes: no deployment has the target in its needle's workspace. This rests on {e.verdict.rests_on}"
        )
    elif e.verdict.boxes:
        answer = "not proved: it may be reachable or not"
    else:
        answer = "cannot be proved this way: some deployments have it in their needle's workspace"
    yield f"Is the target out of the reach of {e.system.name}?", answer


def _file(e: Explanation, plan: object) -> str:
    return e.file_of(plan) or ""


Record = dict[str, Any]
FILE = "no_plan.json"


def save_explanation(explanation: Explanation, folder: str | os.PathLike[str]) -> tuple[str, ...]:
    """Write `no_plan.json` and the plans to a folder, and return their names; FileError if that fails."""
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
        "blocking": [
            {**_structure(each.place), **picked(each, "arcs arcs_at_place"), "of_arcs": each.of}
            for each in e.blocking
        ],
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
        "reached_shares": [
            {
                "region": each.region,
                "reached": each.share.count,
                "of": each.share.samples,
                "interval": list(each.share.interval),
            }
            for each in e.shares
        ],
        "proved_unreachable": None if e.verdict is None else e.verdict.proved,
        "radial_ultrasound": e.ultrasound or None,
        "proof_rests_on": "" if e.verdict is None else e.verdict.rests_on,
        "parts": [{"part": part.name, "outcome": part.outcome, "why": part.why} for part in e.parts],
        "chances_under_default_errors": {
            name: {"succeeds": share.value, "interval": list(share.interval), "procedures": share.samples}
            for name, share in e.chances.items()
        },
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


def _neighbour(e: Explanation) -> Record | None:
    neighbour = e.neighbour
    if neighbour is None:
        return None
    return {
        **point(neighbour.plan.target_lps),
        "from_target_mm": neighbour.from_target_mm,
        "plan": e.file_of(neighbour.plan),
    }


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
