"""The command `lungaccess route`: a route along airways or vessels for a device of limited curvature."""

from pathlib import Path
from typing import TYPE_CHECKING, Literal

from anatomy.base.files import write_json
from anatomy.io.frames import Frame, parse_point
from lungaccess.cli import terminal
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.numbers import NotNegative, Positive, Seed
from lungaccess.cli.options import PatientOptions
from lungaccess.cli.progress import progress
from lungaccess.cli.result_folder import Force, claim_folder

if TYPE_CHECKING:
    from stages.scope.route import Route


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
    output: PatientOptions = PatientOptions(),
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
    from lungaccess.planning.one_stage import open_source, route_record, widest_end
    from lungaccess.showing.report.route import route_png
    from stages.scope.route import RouteLimits, plan_route

    limits = RouteLimits(
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
        opened = open_source(
            source, lumen=lumen, frame=frame, pixel_mm=pixel, cache=output.cache, accept=output.accept
        )
        shown.step("planning")
        end = opened.place(goal, limits.needed_mm)
        first = widest_end(opened.centreline) if start is None else opened.place(start, limits.needed_mm)
        found = plan_route(
            opened.centreline, first, end, limits, repair=repair, seed=seed, require_proof=False
        )
    written = route_record(opened, found)
    write_json(out / "route.json", written)
    route_png(opened.name, opened.centreline, found, out / "route.png")
    if output.json:
        terminal.show_json(written)
        return ExitCode.of(found.proved)
    terminal.show([terminal.table(f"Route along {opened.name}", ("", "", "limit"), _rows(found, written))])
    terminal.show_warnings(opened.warnings)
    terminal.say(f"Written to {out}: route.json, route.png")
    return _verdict(found)


def _rows(found: "Route", written: dict[str, object]) -> list[terminal.Row]:
    limits = found.limits
    return [
        ("length", f"{written['length_mm']:.1f} mm", ""),
        ("largest curvature", f"{written['largest_curvature_per_mm']:.4f} per mm",
         f"at most {limits.max_curvature_per_mm:g}"),
        ("least distance to wall", f"{written['least_wall_mm']:.2f} mm", f"at least {limits.needed_mm:g}"),
        ("mean distance to wall", f"{written['mean_wall_mm']:.2f} mm", ""),
        ("ends off by", f"{found.end_error_mm:.2f} mm", f"at most {limits.end_tolerance_mm:g}"),
        ("proved on the whole curve", "yes" if found.proved else "NO", ""),
    ]  # fmt: skip


def _verdict(found: "Route") -> ExitCode:
    from stages.scope.route import NoRouteError, require_proved

    try:
        require_proved(found)
    except NoRouteError as error:
        terminal.show_error(error)
        return ExitCode.NEGATIVE
    return ExitCode.OK
