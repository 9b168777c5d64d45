"""Printed and JSON steps of a bronchoscope carried out word for word, without anything else of the plan."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from lungaccess.judging.checking.boxes import Boxes
from lungaccess.judging.checking.scope import Motion, least_gap_mm, motion_of

ADVANCE = re.compile(r"advance ([\d.]+) mm, until ([\d.]+) mm are inserted")
TWIST = re.compile(
    r"turn the scope [\d.]+° (?:counter)?clockwise \(seen from behind\), to ([\d.]+)°( counter)?"
)
BEND = re.compile(r"bring the tip from .*? to (straight|([\d.]+)° (up|down))")


def states_of_texts(texts: Iterable[str]) -> np.ndarray:
    """Return the states `(M, 3)` that printed sentences lead through, from the scope as it enters."""
    rows = [[0.0, 0.0, 0.0]]
    for text in texts:
        advance, twist, bend = rows[-1]
        if found := ADVANCE.search(text):
            advance = float(found[2])
        if found := TWIST.search(text):
            twist = (-1.0 if found[2] else 1.0) * float(found[1])
        if found := BEND.search(text):
            bend = 0.0 if found[2] is None else (1.0 if found[3] == "up" else -1.0) * float(found[2])
        rows.append([advance, twist, bend])
    return np.array(rows) * [1.0, np.pi / 180.0, np.pi / 180.0]


def states_of_json(steps: Iterable[Mapping[str, Any]]) -> np.ndarray:
    """Return the states `(M, 3)` that steps of `lungaccess steps --json` lead through."""
    rows = [[each["inserted_mm"], each["to_twist_deg"], each["to_bend_deg"]] for each in steps]
    return np.array([[0.0, 0.0, 0.0], *rows]) * [1.0, np.pi / 180.0, np.pi / 180.0]


def carried_out(record: Mapping[str, Any], states: np.ndarray) -> Motion:
    """Return the motion of states from where the record of `steps --json` has the scope enter."""
    return motion_of(np.array(record["lps_from_entry"]), states, record["bending_length_mm"])


def least_room_mm(motion: Motion, boxes: Boxes, needed_mm: float) -> float:
    """Return by how much the axis is farther from the wall than needed, at most; negative where it is not."""
    return least_gap_mm(motion, boxes, needed_mm, 0.0) - needed_mm


def off(motion: Motion, lps_from_tip: np.ndarray) -> tuple[float, float]:
    """Return by how many mm and degrees the tip of a motion is away from a pose."""
    away = np.linalg.inv(lps_from_tip) @ motion.tip
    turned = np.degrees(np.arccos(np.clip(0.5 * (np.trace(away[:3, :3]) - 1.0), -1.0, 1.0)))
    return float(np.linalg.norm(away[:3, 3])), float(turned)
