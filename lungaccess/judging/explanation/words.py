"""An explanation in words, for the terminal and the page alike, and as plain values and files."""

import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from anatomy.base.files import write_json
from anatomy.base.records import frozen_value
from anatomy.base.typed import Float
from anatomy.base.words import of_hundred, percent, point_in_words
from anatomy.io.frames import LPS_FROM_RAS
from lungaccess.judging.explanation.blocking import ArcBeyondLimits, BlockedArc, Structure
from lungaccess.judging.explanation.explanation import Explanation
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
    starts = {} if e.starts is None else e.starts.counts
    said: tuple[tuple[str, tuple[str, ...], Iterable[Row]], ...] = (
        ("What would reach it", ("what", "how", "plan"), _helps(e)),
        ("Nearest miss", ("what", "how near", "where"), _misses(e)),
        (
            "What blocks the direct arcs within the needle's limits",
            ("structure", "arcs that it stops first", "where most of them are stopped"),
            _blocks(e),
        ),
        (
            f"Other presets, the least invasive first: {len(e.attempts)} of {len(e.presets)} tried",
            ("preset", "outcome", "plan"),
            (
                (name, "not tried", "") if tried is None else (name, tried.why, _file(e, tried.plan))
                for name, tried in e.presets.items()
            ),
        ),
        (
            "Where the needle can start, and why each start fails",
            ("starts", "count"),
            ((why, str(n)) for why, n in starts.items() if n),
        ),
        (f"What {_by(e)} nearby", ("where", "how much"), ((each.region, each.words) for each in e.shares)),
        ("Proof", ("question", "answer"), _proof(e)),
        (
            "Not tried: nothing follows from these",
            ("what", "why"),
            ((part.name, part.why) for part in e.not_tried),
        ),
    )
    made = (Section(title=title, headings=heads, rows=tuple(rows)) for title, heads, rows in said)
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
    e, near = explanation, explanation.neighbour
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
            "nearest_point_reached": None
            if near is None
            else {
                **point(near.plan.target_lps),
                "from_target_mm": near.from_target_mm,
                "plan": e.file_of(near.plan),
            },
        },
        "presets": [
            {"system": name, "tried": False}
            if attempt is None
            else {
                "system": attempt.system.name,
                "tried": True,
                "found": attempt.succeeded,
                "why": attempt.why,
                "plan": e.file_of(attempt.plan),
            }
            for name, attempt in e.presets.items()
        ],
        "changes": [
            {
                "change": str(each.change),
                "parameter": each.change.parameter,
                "present_mm": each.change.present,
                "needed_mm": each.change.needed,
                "accepted": each.accepted,
                "plan": e.file_of(each.change.plan),
            }
            for each in e.changes
        ],
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
