"""The command `lungaccess reach`: what a system, or several, can reach of a patient's lung."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from anatomy.base.errors import SettingsError
from anatomy.base.files import require_writable_folder, write_json
from anatomy.base.words import of_hundred, percent
from lungaccess.cli import terminal
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.numbers import CountOrNone, Spacing
from lungaccess.cli.options import PatientFolder, PatientOptions, PhasesText, SystemOptions, stated_phases
from lungaccess.cli.progress import progress
from lungaccess.cli.result_folder import Force, claim_folder

if TYPE_CHECKING:
    from rich.table import Table

    from lungaccess.planning.reachability import ReachMap, RegionReach


def reach(
    patient: PatientFolder,
    *,
    system: SystemOptions = SystemOptions(),
    spacing: Spacing = 3.0,
    search: CountOrNone = 0,
    compare: str | None = None,
    phases: PhasesText = None,
    out: Path = Path("lungaccess-reach"),
    page: Path | None = None,
    force: Force = False,
    output: PatientOptions = PatientOptions(),
) -> ExitCode:
    """Map what a system reaches of the lung, and write the map as volumes for 3D Slicer and as a picture.

    A run that was stopped goes on where it was if it is started again with the same options.

    Args:
        spacing: Side of the map's voxels, mm.
        search: Random trees for each point that no single arc reaches; 0 for single arcs only.
        compare: Further presets or TOML files to compare with, separated by commas.
        out: Folder for the volumes, the pictures and reach.json.
        page: HTML file that shows the maps over slices and in 3-D, with the volumes; it opens offline.
    """
    from lungaccess.planning.reachability.reach_map import compare_reach
    from lungaccess.problem.system import load_system
    from lungaccess.showing.report import reach_png

    names = [system.system, *(name.strip() for name in (compare or "").split(",") if name.strip())]
    systems = [load_system(name, fissures_allowed=system.allow_fissures) for name in dict.fromkeys(names)]
    asked = stated_phases(phases)
    if asked is not None and search:
        raise SettingsError(
            "--search is asked for with --phases", expected="single arcs only", remedy="Leave out --search"
        )
    folder = claim_folder(out, ("reach.json", "reach.png", "reach*.nrrd", "reach-*.png"), force=force)
    if page is not None:
        require_writable_folder(page.parent)
    lung = output.load(patient)
    with progress("scanning") as shown:
        maps = compare_reach(
            lung, systems, spacing_mm=spacing, trees=search, phases=asked, work=folder, progress=shown.step
        )
    stems = _stems(maps)
    for stem, each in zip(stems, maps, strict=True):
        each.save(folder, stem)
        reach_png(each, lung, folder / f"{stem}.png")
    written = [record(each) for each in maps]
    write_json(folder / "reach.json", written)
    if page is not None:
        from lungaccess.showing.report.html import reach_page

        reach_page(maps, lung, page)
    if output.json:
        terminal.show_json(written)
        return ExitCode.OK
    terminal.show([_region_table(each) for each in maps])
    if len(maps) > 1:
        terminal.show([_comparison_table(maps)])
    parts = ("", "-cost", "-clearance", "-deployment", *(("-window",) if asked else ()))
    ends = (*(f"{part}.nrrd" for part in parts), ".png")
    files = ", ".join(f"{stem}{end}" for stem in stems for end in ends)
    also = "" if page is None else f"; {page}"
    terminal.say(f"Written to {out}: {files}, reach.json{also}")
    return ExitCode.OK


def _stems(maps: tuple[ReachMap, ...]) -> list[str]:
    """Return a file name for each map, without what a file name may not hold."""
    if len(maps) == 1:
        return ["reach"]
    plain = ["".join(c if c.isalnum() or c in "-_" else "-" for c in each.system.name) for each in maps]
    return [f"reach-{n}-{name}" for n, name in enumerate(plain, start=1)]


def record(reach: ReachMap) -> dict[str, object]:
    """Return the figures of a map as plain values."""
    from lungaccess.planning.reachability import KINDS, NOT_COUNTED

    system, needle = reach.system, reach.system.needle
    return {
        "patient": reach.patient_name,
        "system": system.name,
        "scope_diameter_mm": system.scope.outer_diameter_mm,
        "needle_diameter_mm": None if needle is None else needle.diameter_mm,
        "needle_radius_of_curvature_mm": None if needle is None else needle.min_radius_of_curvature_mm,
        "fissures_are_obstacles": reach.with_fissures,
        "spacing_mm": float(reach.kinds.grid.spacing_mm[0]),
        "labels": {"not counted": NOT_COUNTED, **KINDS},
        "deployments": reach.entries,
        "lungs_are_separate": reach.regions.lungs_are_separate,
        "regions": [_plain(row) for row in reach.by_region()],
        "segments": [_plain(row) for row in reach.by_segment()],
        "phases": None if reach.phases is None else list(reach.phases),
        "resumed_layers": reach.resumed_layers,
        "timing": {"scan_s": reach.scan_s, "atlas_s": reach.atlas_s},
    }


def _plain(row: RegionReach) -> dict[str, object]:
    from lungaccess.planning.reachability import KINDS, STATES

    return {
        "name": row.name,
        "volume_ml": row.volume_ml,
        "states_ml": {state: row.state_ml(state) for state in STATES},
        "shares": dict(zip(KINDS, row.shares, strict=True)),
        "median_cost": row.median_cost if row.reached else None,
        "median_clearance_mm": row.median_clearance_mm if row.reached else None,
    }


def _region_table(reach: ReachMap) -> Table:
    from lungaccess.planning.reachability import STATES

    rows = [
        (
            row.name,
            f"{row.volume_ml:.0f}",
            *(f"{row.state_ml(state):.0f} ({percent(row.share(state))})" for state in STATES),
            f"{row.median_cost:.2f}",
            f"{row.median_clearance_mm:.2f}",
        )
        for row in (*reach.by_region(), *reach.by_segment())
    ]
    headings = ("", "mL", *(f"{state}, mL" for state in STATES), "median cost", "median clearance, mm")
    during = "" if reach.phases is None else ", phases {:g} to {:g}".format(*reach.phases)
    return terminal.table(f"{reach.system.name} in {reach.patient_name}{during}", headings, rows)


def _comparison_table(maps: tuple[ReachMap, ...]) -> Table:
    first = maps[0]
    rows = [
        (
            each.system.name,
            f"{each.system.scope.outer_diameter_mm:g}",
            *each.system.needle_sizes,
            *(of_hundred(row.reached) for row in each.by_region()),
            f"{gained:.0f}",
            f"{lost:.0f}",
        )
        for each in maps
        for gained, lost in [each.gained_and_lost_ml(first)]
    ]
    names = [row.name for row in first.by_region()]
    headings = (
        "system", "scope, mm", "needle, mm", "radius, mm", *(f"{name}, %" for name in names), "gained, mL",
        "lost, mL",
    )  # fmt: skip
    return terminal.table("Share reached; volume gained and lost beside the first", headings, rows)
