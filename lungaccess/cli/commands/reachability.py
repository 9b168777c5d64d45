"""The commands `lungaccess reach` and `certify`: what a system reaches, and proof that it does not."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter
from rich.table import Table

from anatomy.base.errors import SettingsError
from anatomy.base.files import require_writable_folder, write_json
from anatomy.base.words import of_hundred, percent
from lungaccess.cli import lazy, options, terminal
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.numbers import Count, CountOrNone, Seconds, Spacing
from lungaccess.cli.progress import progress
from lungaccess.cli.result_folder import Force, claim_folder
from lungaccess.plans.record import picked


def reach(
    patient: options.PatientFolder,
    *,
    system: options.SystemOptions = options.SystemOptions(),
    spacing: Spacing = 3.0,
    search: CountOrNone = 0,
    compare: str | None = None,
    phases: options.PhasesText = None,
    out: Path = Path("lungaccess-reach"),
    page: Path | None = None,
    force: Force = False,
    masks: options.PatientOptions = options.PatientOptions(),
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
    others = (name.strip() for name in (compare or "").split(",") if name.strip())
    names = dict.fromkeys([system.system, *others])
    systems = [lazy.load_system(name, fissures_allowed=system.allow_fissures) for name in names]
    asked = options.stated_phases(phases)
    if asked is not None and search:
        raise SettingsError(
            "--search is asked for with --phases", expected="single arcs only", remedy="Leave out --search"
        )
    folder = claim_folder(out, ("reach.json", "reach.png", "reach*.nrrd", "reach-*.png"), force=force)
    if page is not None:
        require_writable_folder(page.parent)
    lung = masks.load(patient)
    with progress("scanning") as shown:
        maps = lazy.compare_reach(
            lung, systems, spacing_mm=spacing, trees=search, phases=asked, work=folder, progress=shown.step
        )
    stems = _stems(maps)
    for stem, each in zip(stems, maps, strict=True):
        each.save(folder, stem)
        lazy.reach_png(each, lung, folder / f"{stem}.png")
    written = [record(each) for each in maps]
    write_json(folder / "reach.json", written)
    if page is not None:
        lazy.reach_page(maps, lung, page)
    terminal.tell(written)
    terminal.show([_region_table(each) for each in maps])
    if len(maps) > 1:
        terminal.show([_comparison_table(maps)])
    parts = ("", "-cost", "-clearance", "-deployment", *(("-window",) if asked else ()))
    ends = (*(f"{part}.nrrd" for part in parts), ".png")
    files = ", ".join(f"{stem}{end}" for stem in stems for end in ends)
    also = "" if page is None else f"; {page}"
    terminal.say(f"Written to {out}: {files}, reach.json{also}")
    return ExitCode.OK


def _stems(maps: tuple[lazy.ReachMap, ...]) -> list[str]:
    """Return a file name for each map, without what a file name may not hold."""
    if len(maps) == 1:
        return ["reach"]
    plain = ["".join(c if c.isalnum() or c in "-_" else "-" for c in each.system.name) for each in maps]
    return [f"reach-{n}-{name}" for n, name in enumerate(plain, start=1)]


def record(reach: lazy.ReachMap) -> dict[str, object]:
    """Return the figures of a map as plain values."""
    system, needle = reach.system, reach.system.needle
    return {
        "patient": reach.patient_name,
        "system": system.name,
        "scope_diameter_mm": system.scope.outer_diameter_mm,
        "needle_diameter_mm": None if needle is None else needle.diameter_mm,
        "needle_radius_of_curvature_mm": None if needle is None else needle.min_radius_of_curvature_mm,
        "fissures_are_obstacles": reach.with_fissures,
        "spacing_mm": float(reach.kinds.grid.spacing_mm[0]),
        "labels": {"not counted": lazy.NOT_COUNTED, **lazy.KINDS},
        "deployments": reach.entries,
        "lungs_are_separate": reach.regions.lungs_are_separate,
        "regions": [_plain(row) for row in reach.by_region()],
        "segments": [_plain(row) for row in reach.by_segment()],
        "phases": None if reach.phases is None else list(reach.phases),
        "resumed_layers": reach.resumed_layers,
        "timing": {"scan_s": reach.scan_s, "atlas_s": reach.atlas_s},
    }


def _plain(row: lazy.RegionReach) -> dict[str, object]:
    return {
        "name": row.name,
        "volume_ml": row.volume_ml,
        "states_ml": {state: row.state_ml(state) for state in lazy.STATES},
        "shares": dict(zip(lazy.KINDS, row.shares, strict=True)),
        "median_cost": row.median_cost if row.reached else None,
        "median_clearance_mm": row.median_clearance_mm if row.reached else None,
    }


def _region_table(reach: lazy.ReachMap) -> Table:
    rows = [
        (
            row.name,
            f"{row.volume_ml:.0f}",
            *(f"{row.state_ml(state):.0f} ({percent(row.share(state))})" for state in lazy.STATES),
            f"{row.median_cost:.2f}",
            f"{row.median_clearance_mm:.2f}",
        )
        for row in (*reach.by_region(), *reach.by_segment())
    ]
    headings = ("", "mL", *(f"{state}, mL" for state in lazy.STATES), "median cost", "median clearance, mm")
    during = "" if reach.phases is None else ", phases {:g} to {:g}".format(*reach.phases)
    return terminal.table(f"{reach.system.name} in {reach.patient_name}{during}", headings, rows)


def _comparison_table(maps: tuple[lazy.ReachMap, ...]) -> Table:
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
    headings = (
        "system", "scope, mm", "needle, mm", "radius, mm", *(f"{row.name}, %" for row in first.by_region()),
        "gained, mL", "lost, mL",
    )  # fmt: skip
    return terminal.table("Share reached; volume gained and lost beside the first", headings, rows)


def certify(
    patient: options.PatientFolder,
    *,
    target: options.TargetOptions = options.TargetOptions(),
    system: options.SystemOptions = options.SystemOptions(),
    most_boxes: Count | None = None,
    time_s: Annotated[Seconds | None, Parameter(name="--time")] = None,
    out: Path | None = None,
    masks: options.PatientOptions = options.PatientOptions(),
) -> ExitCode:
    """Prove that a target is unreachable: from no place in the airways, however scope and tubes are turned.

    Exit code 0 if it is proved, 1 if it is not: then nothing is known of the target, but which share of the
    deployments is ruled out, and where the others start.

    Args:
        most_boxes: Ranges of deployments to look at before the proof is given up; 20 million if not given.
        time_s: Seconds to look at them, after the preparation; the same time need not give the same answer.
        out: PNG file that shows what is ruled out and what is open.
    """
    if out is not None:
        options.require_picture(out)
    stated = target.stated()
    device = system.load()
    lung = masks.load(patient)
    point = stated.centre_lps(lung)
    with progress("proving") as shown:
        proof = lazy.UnreachableProof(lung, device, with_fissures=not device.fissures_allowed)
        verdict = proof.prove(
            point,
            most_boxes=most_boxes or lazy.MOST_BOXES,
            time_s=time_s,
            progress=lambda share: shown.step("proving", share),
        )
    if out is not None:
        lazy.open_places_png(lung, proof, verdict, point, out)
    asked = {"patient": lung.name, "system": device.name, "target_lps_mm": point.tolist()}
    terminal.tell(
        {
            **asked,
            **lazy.made_by(),
            "proved_unreachable": verdict.proved,
            **picked(verdict, "boxes share_ruled_out finished rests_on"),
            "open_place_lps_mm": None if verdict.open_lps is None else verdict.open_lps.tolist(),
            "open_places": [
                picked(place, "branch generation name share narrowest")
                | {"tip_lps_mm": place.tip_lps.tolist(), "insertions_mm": list(place.insertions_mm)}
                for place in verdict.open_places
            ],
        }
    )
    rows = [
        ("system", device.name),
        ("outcome", "proved unreachable" if verdict.proved else "not proved: it may be reachable or not"),
        ("deployments ruled out", f"{_percent(verdict.share_ruled_out)} of the deployment space"),
        ("ranges of deployments looked at", f"{verdict.boxes:,}"),
    ]
    if verdict.rests_on:
        rows.append(("rests on", verdict.rests_on))
    if verdict.open_places:
        branches = len({place.branch for place in verdict.open_places})
        rows.append(("open", f"{len(verdict.open_places)} places in {branches} branches"))
        # Open places that the table names.
        rows += [
            (
                "",
                f"branch {place.name}, generation {place.generation}, from {lazy.point(place.tip_lps)} "
                f"(LPS mm): {100.0 * place.share:.2g} % of the space",
            )
            for place in verdict.open_places[:8]
        ]
    if out is not None:
        rows.append(("picture", str(out)))
    terminal.show([terminal.table("proof", ("", ""), rows)])
    return ExitCode.of(verdict.proved)


def _percent(share: float) -> str:
    """Return a share in percent, with as many digits as tell it from all of it."""
    for digits in (1, 3, 6):
        if share == 1.0 or round(100.0 * share, digits) < 100.0:
            return f"{100.0 * share:.{digits}f} %"
    return "all but a millionth of a percent"
