"""The page of a reachability map: over the slices, in 3-D, and as volumes by side and system."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from anatomy.base.words import of_hundred
from anatomy.grid import Volume
from anatomy.lung import Lung
from lungaccess.planning.reachability import ReachMap
from lungaccess.showing.report.html import words
from lungaccess.showing.report.html.document import scene_figure, slice_controls, write_page
from lungaccess.showing.report.html.meshes import Look, packed_surface, structure_meshes
from lungaccess.showing.report.html.volumes import page_image
from lungaccess.showing.report.pack import Packed, pack
from lungaccess.showing.report.reach import CLEARANCE_MM, COLOURS, fullest_point

MODULES = ("reach.js",)
STEPS_PER_MM = 25.0
"""A clearance is stored in steps of 0.04 mm, up to 10.2 mm."""
SURFACES = {
    "reachable": COLOURS["direct arc"],
    "unreachable": COLOURS["unreachable"],
    "undecided": COLOURS["undecided"],
}


def reach_page(maps: Sequence[ReachMap], lung: Lung, path: str | os.PathLike[str]) -> Path:
    """Write the page of one or several maps of a lung to one HTML file that opens offline.

    Raises FileError if the file cannot be written.

    Args:
        maps: All of one lung; each has its own system.
    """
    first = maps[0]
    centre = fullest_point(first.kinds)
    parts = {
        "title": words.text(f"What can be reached of {lung.name}"),
        "summary": words.text(
            f"Voxels of {first.kinds.grid.spacing_mm[0]:g} mm, each classified at its centre; "
            "not counted: outside the lung, in an obstacle"
        ),
        "slice_controls": slice_controls(),
        "key": "".join(
            f'<li><span class="swatch" style="background: {colour}"></span>{words.text(name)}</li>'
            for name, colour in COLOURS.items()
        ),
        "most_clearance": f"{CLEARANCE_MM[1]:g}",
        "scene": scene_figure(),
        "volumes": _volumes_section(maps),
        "systems": _systems_section(maps),
    }
    data = {
        "page": "reach", "patient": lung.name, "structures": structure_meshes(lung),
        **page_image(lung, centre[None]), "centre_lps": centre.tolist(), "colours": COLOURS,
        "clearance_range_mm": list(CLEARANCE_MM), "maps": [packed_map(each) for each in maps],
    }  # fmt: skip
    return write_page(path, "reach.html", MODULES, data, parts)


def packed_map(reach: ReachMap) -> Packed:
    """Return a map for the scripts: its kinds and clearances, and the surfaces of what is reached and not."""
    from lungaccess.planning.reachability import KINDS

    clearance = np.clip(np.rint(reach.clearance_mm.array * STEPS_PER_MM), 0, 255).astype(np.uint8)
    return {
        "name": reach.system.name, "kinds": {name: int(code) for name, code in KINDS.items()},
        "lps_from_ijk": reach.kinds.grid.lps_from_ijk.tolist(), "shape": list(reach.kinds.grid.shape),
        "kind": pack(reach.kinds.array.transpose(2, 1, 0), "u1"),
        "clearance": pack(clearance.transpose(2, 1, 0), "u1"), "steps_per_mm": STEPS_PER_MM,
        "surfaces": _surfaces(reach),
    }  # fmt: skip


def _surfaces(reach: ReachMap) -> list[Packed]:
    masks = {state: reach.in_state(state) for state in SURFACES}
    cell_mm = 0.9 * float(reach.kinds.grid.spacing_mm.max())
    return [
        packed_surface(
            Volume(grid=reach.kinds.grid, array=mask),
            Look(
                key=name, name=name.capitalize(), colour=SURFACES[name], opacity=0.28,
                shown=name == "reachable", cell_mm=cell_mm, most_faces=60_000,
            ),
        )
        for name, mask in masks.items()
        if mask.any()
    ]  # fmt: skip


def _volumes_section(maps: Sequence[ReachMap]) -> str:
    """Return a table of volumes by side for each system, in mL and as a share."""
    from lungaccess.planning.reachability import STATES

    headings = (
        "", "tissue, mL", *(f"{state}, mL (%)" for state in STATES), "reachable by search alone, mL",
        "median 1/clearance integral", "median clearance, mm",
    )  # fmt: skip
    tables = []
    for each in maps:
        rows = [
            (
                words.text(row.name),
                f"{row.volume_ml:.0f}",
                *(f"{row.state_ml(state):.0f} ({of_hundred(row.share(state))})" for state in STATES),
                f"{row.volume_ml * row.shares[1]:.0f}",
                words.number(row.median_cost),
                words.number(row.median_clearance_mm),
            )
            for row in (*each.by_region(), *each.by_segment())
        ]
        tables.append(words.table(each.system.name, headings, rows))
    note = "The patient came without lobes." if any(each.regions.lobes is None for each in maps) else ""
    return "".join(tables) + f"<p class='note'>{note}</p>"


def _systems_section(maps: Sequence[ReachMap]) -> str:
    """Return a table of the systems: their sizes, and what each gains and loses beside the first."""
    rows = []
    for each in maps:
        gained, lost = each.gained_and_lost_ml(maps[0])
        figures: list[Any] = [
            f"{each.system.scope.outer_diameter_mm:g}", *each.system.needle_sizes,
            "are obstacles" if each.with_fissures else "may be crossed or have no mask", each.entries,
            of_hundred(each.total.reached), f"{gained:.0f}", f"{lost:.0f}",
        ]  # fmt: skip
        rows.append((words.text(each.system.name), *(words.text(figure) for figure in figures)))
    headings = (
        "system", "scope, mm", "needle, mm", "radius of curvature, mm", "fissures", "deployments",
        "reached, %", "gained beside the first, mL", "lost, mL",
    )  # fmt: skip
    return words.table("Systems", headings, rows)
