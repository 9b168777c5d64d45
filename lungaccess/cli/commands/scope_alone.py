"""The commands `lungaccess advise`, `tour` and `route`: ways of a bronchoscope or catheter alone."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from anatomy.base.files import write_json
from anatomy.io.frames import Frame, parse_point
from lungaccess.cli import lazy, terminal
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.numbers import CountOrNone, NotNegative, Positive, Seed
from lungaccess.cli.options import DEFAULT_SYSTEM, PatientFolder, PatientOptions, TargetOptions, open_atlas
from lungaccess.cli.progress import progress
from lungaccess.cli.result_folder import Force, claim_folder


def advise(
    patient: PatientFolder,
    *,
    target: TargetOptions = TargetOptions(),
    lesion_radius: Positive = 5.0,
    system: str = DEFAULT_SYSTEM,
    seed: Seed = 0,
    out: Path = Path("lungaccess-advice"),
    force: Force = False,
    masks: PatientOptions = PatientOptions(),
) -> ExitCode:
    """Advise the bronchoscope: turn by turn to a lesion, or as near as it gets, and why not nearer.

    The goal is the airway voxel nearest to the lesion's centre, if possible one in the lesion where the scope
    fits.  Exit code 0 if the scope reaches it, 1 if it stops before.

    Args:
        lesion_radius: Radius of the lesion, mm.
        system: Preset or TOML file whose scope is used.
        seed: Seed of the random numbers.
        out: Folder for advice.json and camera.mrk.json, the flight of the camera for 3D Slicer.
    """
    stated = target.stated()
    claim_folder(out, (lazy.ADVICE_FILE, lazy.CAMERA_FILE), force=force)
    device = lazy.load_system(system)
    lung = masks.load(patient)
    with progress("steering the scope"):
        advice = lazy.advise_scope(lung, device, stated.centre_lps(lung), lesion_radius, seed=seed)
    lazy.save_advice(advice, out)
    terminal.tell(advice.as_json())
    _show_advise(advice)
    terminal.say(f"Written to {out}: {lazy.ADVICE_FILE}, {lazy.CAMERA_FILE}")
    return ExitCode.of(advice.path.reached)


def _show_advise(advice: lazy.ScopeAdvice) -> None:
    path = advice.path
    rows = [("outcome", "reaches the goal in the airway")]
    if not path.reached:
        rows = [("outcome", f"stops {path.distance_mm:.1f} mm from the goal"), ("why", advice.why_stopped)]
    rows += [("insertion", f"{path.length_mm:.0f} mm"), ("retreats", f"{path.retreats}")]
    inside = (
        "inside it" if path.distance_to_lesion_mm == 0.0 else f"{path.distance_to_lesion_mm:.1f} mm from it"
    )
    rows.append(("tip and lesion", inside))
    if not path.goal.in_lesion:
        rows.append(
            ("lesion", f"touches no lumen; the nearest is {path.goal.distance_mm:.1f} mm from its centre")
        )
    terminal.show([terminal.table("bronchoscope", ("", ""), rows)])
    for number, one in enumerate(advice.instructions, start=1):
        terminal.say(f"{number}. {one.text()}")
    terminal.console.print()
    if advice.thinner:
        thinner = [
            (f"{2.0 * one.radius_mm:.1f}", "yes" if one.reached else "no", f"{one.distance_mm:.1f}")
            for one in advice.thinner
        ]
        headings = ("diameter with gap, mm", "reaches the goal", "left, mm")
        terminal.show([terminal.table("Thinner scopes of the same bends", headings, thinner)])


def tour(
    patient: PatientFolder,
    *,
    targets: Path | None = None,
    system: str = DEFAULT_SYSTEM,
    require_plan: bool = True,
    iterations: CountOrNone = 100,
    closed: bool = False,
    reading: Literal["printed", "reduced"] = "printed",
    beta: NotNegative = 0.2,
    tissue_weight: NotNegative = 0.0,
    speed: Positive = 10.0,
    per_lesion: NotNegative = 300.0,
    out: Path = Path("lungaccess-tour"),
    force: Force = False,
    masks: PatientOptions = PatientOptions(),
) -> ExitCode:
    """Plan the shortest tour of the scope to several lesions, and draw it; exit code 1 if one is left out.

    Args:
        targets: Text file with one lesion a line: ras:x,y,z or lps:x,y,z, mm; the patient's own targets if
            not given.
        system: Preset or TOML file whose devices reach the lesions from the airway.
        require_plan: Count an exit only if a coupled plan of scope, tubes and needle from there was found.
        iterations: Of the planner, for a lesion that no direct arc of the needle reaches.
        closed: Return to the root of the airway after the last lesion.
        reading: How the resistances of Pan et al. 2025 are merged: as printed, or by true reduction of the
            tree.
        beta: Weight of the angle in the resistance; the paper's worked example needs 2.5.
        tissue_weight: How many mm of the scope's travel a mm between exit and lesion is worth, for the
            shortest tour.
        speed: Speed of the scope, mm/s, for the times.
        per_lesion: Time that each lesion takes besides, s.
        out: Folder for tour.json and tour.png.
    """
    stated = None if targets is None else lazy.read_lesions(targets)
    claim_folder(out, ("tour.json", "tour.png"), force=force)
    device = lazy.load_system(system)
    lung = masks.load(patient)
    lesions = lazy.lesions_of(lung) if stated is None else stated
    atlas = open_atlas(lung, device) if require_plan else None
    with progress("planning the tour"):
        answer = lazy.plan_tour(
            lung,
            lesions,
            weights=lazy.Resistances(beta=beta),
            reading=reading,
            closed=closed,
            tissue_weight=tissue_weight,
            atlas=atlas,
            iterations=iterations,
        )
    write_json(out / "tour.json", lazy.tour_record(answer))
    lazy.tour_png(answer, lung, out / "tour.png")
    terminal.tell(lazy.tour_record(answer))
    _show_tour(answer, speed, per_lesion)
    terminal.say(f"Written to {out}: tour.json, tour.png")
    for number, why in answer.left_out.items():
        terminal.say(f"Left out, lesion {number}: {why}.")
    return ExitCode.of(not answer.left_out)


def _show_tour(answer: lazy.TourAnswer, speed: float, per_lesion: float) -> None:
    rows = [_summary("shortest", answer.shortest, answer, speed, per_lesion)]
    if answer.least_resistance is not None:
        rows.append(_summary("least resistance", answer.least_resistance, answer, speed, per_lesion))
    count = len(answer.lesions_lps)
    habit_s = answer.one_by_one_mm / speed + per_lesion * count
    rows.append(
        (
            "one by one, back to the root",
            f"{answer.one_by_one_mm:.0f}",
            f"{habit_s:.0f}",
            f"{habit_s / count:.0f}",
            "",
            "",
        )
    )
    headings = ("tour", "length, mm", "time, s", "s a lesion", "saved, %", "order of lesions")
    visits = [
        (
            str(number),
            str(answer.numbers[visit.lesion]),
            ", ".join(visit.roles),
            f"{visit.distance_mm:.1f}",
            f"{visit.angle_rad * 57.29578:.0f}",
        )
        for number, visit in enumerate(answer.shortest.visits, 1)
    ]
    exits = "each exit has a coupled plan" if answer.plan_required else "exits without plans"
    terminal.show(
        [
            terminal.table(f"{answer.title.capitalize()} ({exits})", headings, rows),
            terminal.table(
                "Visits of the shortest tour",
                ("visit", "lesion", "exit", "from the lesion, mm", "angle, deg"),
                visits,
            ),
        ]
    )


def _summary(
    name: str, tour: lazy.Itinerary, answer: lazy.TourAnswer, speed: float, per_lesion: float
) -> tuple[str, ...]:
    seconds = tour.seconds(speed, per_lesion)
    saved = 100.0 * (1.0 - tour.length_mm / answer.one_by_one_mm)
    return (
        name,
        f"{tour.length_mm:.0f}",
        f"{seconds:.0f}",
        f"{seconds / len(tour.order):.0f}",
        f"{saved:.0f}",
        " ".join(str(answer.numbers[lesion]) for lesion in tour.order),
    )


def route(
    source: Path,
    *,
    goal: str,
    start: str | None = None,
    lumen: Literal["hepatic-vein", "portal-vein", "hepatic-artery"] | None = None,
    curvature: Positive,
    radius: NotNegative = 0.0,
    margin: NotNegative = 0.0,
    tolerance: NotNegative = 0.0,
    repair: Literal["exact", "ga"] = "exact",
    seed: Seed = 0,
    frame: Frame | None = None,
    pixel: Positive | None = None,
    out: Path = Path("lungaccess-route"),
    force: Force = False,
    masks: PatientOptions = PatientOptions(),
) -> ExitCode:
    """Plan a route of limited curvature along airways or vessels, prove it on the whole curve, draw it.

    Args:
        source: Folder of a patient, a centreline with radii (.vtp, .vtu), a mask of vessels, or a drawing
            (.png).
        goal: Goal in mm with its frame: ras:x,y,z or lps:x,y,z; for a drawing lps:x,y,0, x to the right, y
            down; or the name of a target that came with the patient: the place nearest to it.
        start: Start; the widest end of the tubes if not given.
        lumen: Vessel of a liver of Med-RAD in which the device moves.
        curvature: Largest curvature of the device, 1/mm.
        radius: Outer radius of the device, mm.
        margin: Gap that must remain between device and wall, mm.
        tolerance: How far the ends of the route may lie from start and goal, mm.
        repair: exact: a nonlinear program; ga: the genetic search of Li et al. 2021.
        seed: Seed of the genetic search.
        frame: Frame of a centreline file or mask that states none.
        pixel: Size of a pixel of a drawing, mm.
        out: Folder for route.json and route.png.
    """
    limits = lazy.RouteLimits(
        max_curvature_per_mm=curvature,
        device_radius_mm=radius,
        wall_margin_mm=margin,
        end_tolerance_mm=tolerance,
    )
    for text in (goal, start or goal):
        if ":" in text:
            parse_point(text)
    claim_folder(out, ("route.json", "route.png"), force=force)
    with progress("route") as shown:
        shown.step("reading the tubes")
        opened = lazy.open_source(source, lumen=lumen, frame=frame, pixel_mm=pixel, accept=masks.accept)
        shown.step("planning")
        end = opened.place(goal, limits.needed_mm)
        first = lazy.widest_end(opened.centreline) if start is None else opened.place(start, limits.needed_mm)
        found = lazy.plan_route(
            opened.centreline, first, end, limits, repair=repair, seed=seed, require_proof=False
        )
    written = lazy.route_record(opened, found)
    write_json(out / "route.json", written)
    lazy.route_png(opened.name, opened.centreline, found, out / "route.png")
    terminal.tell(written)
    if terminal.console.as_json:
        return ExitCode.of(found.proved)
    rows = [
        ("length", f"{written['length_mm']:.1f} mm", ""),
        ("largest curvature", f"{written['largest_curvature_per_mm']:.4f} per mm",
         f"at most {limits.max_curvature_per_mm:g}"),
        ("least distance to wall", f"{written['least_wall_mm']:.2f} mm", f"at least {limits.needed_mm:g}"),
        ("mean distance to wall", f"{written['mean_wall_mm']:.2f} mm", ""),
        ("ends off by", f"{found.end_error_mm:.2f} mm", f"at most {limits.end_tolerance_mm:g}"),
        ("proved on the whole curve", "yes" if found.proved else "NO", ""),
    ]  # fmt: skip
    terminal.show([terminal.table(f"Route along {opened.name}", ("", "", "limit"), rows)])
    terminal.show_warnings(opened.warnings)
    terminal.say(f"Written to {out}: route.json, route.png")
    try:
        lazy.require_proved(found)
    except lazy.NoRouteError as error:
        terminal.show_error(error)
        return ExitCode.NEGATIVE
    return ExitCode.OK
