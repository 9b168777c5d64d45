"""The command `lungaccess tour`: several lesions in one procedure."""

from pathlib import Path
from typing import TYPE_CHECKING, Literal

from anatomy.base.files import write_json
from lungaccess.cli import terminal
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.numbers import CountOrNone, NotNegative, Positive
from lungaccess.cli.options import DEFAULT_SYSTEM, PatientFolder, PatientOptions
from lungaccess.cli.progress import progress
from lungaccess.cli.result_folder import Force, claim_folder

if TYPE_CHECKING:
    from lungaccess.planning import TourAnswer
    from stages.scope.tour import Itinerary


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
    output: PatientOptions = PatientOptions(),
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
    from lungaccess.planning import lesions_of, plan_tour, read_lesions, tour_record
    from lungaccess.problem.system import load_system
    from lungaccess.showing.report.tour import tour_png
    from stages.scope.tour import Resistances

    stated = None if targets is None else read_lesions(targets)
    claim_folder(out, ("tour.json", "tour.png"), force=force)
    device = load_system(system)
    lung, atlas = output.load(patient), None
    lesions = lesions_of(lung) if stated is None else stated
    if require_plan:
        atlas = output.open_atlas(lung, device)
    with progress("planning the tour"):
        answer = plan_tour(
            lung,
            lesions,
            weights=Resistances(beta=beta),
            reading=reading,
            closed=closed,
            tissue_weight=tissue_weight,
            atlas=atlas,
            iterations=iterations,
        )
    write_json(out / "tour.json", tour_record(answer))
    tour_png(answer, lung, out / "tour.png")
    if output.json:
        terminal.show_json(tour_record(answer))
        return ExitCode.of(not answer.left_out)
    _show(answer, speed, per_lesion)
    terminal.say(f"Written to {out}: tour.json, tour.png")
    for number, why in answer.left_out.items():
        terminal.say(f"Left out, lesion {number}: {why}.")
    return ExitCode.of(not answer.left_out)


def _show(answer: "TourAnswer", speed: float, per_lesion: float) -> None:
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
    name: str, tour: "Itinerary", answer: "TourAnswer", speed: float, per_lesion: float
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
