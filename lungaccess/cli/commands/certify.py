"""The command `lungaccess certify`: proof that a target is out of a system's reach."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from lungaccess.cli import terminal
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.numbers import Count, Seconds
from lungaccess.cli.options import (
    PatientFolder,
    PatientOptions,
    SystemOptions,
    TargetOptions,
    require_picture,
)
from lungaccess.cli.progress import progress

if TYPE_CHECKING:
    from lungaccess.planning.reachability import OpenPlace, ReachVerdict


def certify(
    patient: PatientFolder,
    *,
    target: TargetOptions = TargetOptions(),
    system: SystemOptions = SystemOptions(),
    most_boxes: Count | None = None,
    time_s: Annotated[Seconds | None, Parameter(name="--time")] = None,
    out: Path | None = None,
    output: PatientOptions = PatientOptions(),
) -> ExitCode:
    """Prove that a target is unreachable: from no place in the airways, however scope and tubes are turned.

    Exit code 0 if it is proved, 1 if it is not: then nothing is known of the target, but which share of the
    deployments is ruled out, and where the others start.

    Args:
        most_boxes: Ranges of deployments to look at before the proof is given up; 20 million if not given.
        time_s: Seconds to look at them, after the preparation; the same time need not give the same answer.
        out: PNG file that shows what is ruled out and what is open.
    """
    from lungaccess.planning.reachability import MOST_BOXES, UnreachableProof
    from lungaccess.plans.version import made_by

    if out is not None:
        require_picture(out)
    stated = target.stated()
    device = system.load()
    lung = output.load(patient)
    point = stated.centre_lps(lung)
    with progress("proving") as shown:
        proof = UnreachableProof(lung, device, with_fissures=not device.fissures_allowed)
        verdict = proof.prove(
            point,
            most_boxes=most_boxes or MOST_BOXES,
            time_s=time_s,
            progress=lambda share: shown.step("proving", share),
        )
    if out is not None:
        from lungaccess.showing.report.open_places import open_places_png

        open_places_png(lung, proof, verdict, point, out)
    if output.json:
        asked = {"patient": lung.name, "system": device.name, "target_lps_mm": point.tolist()}
        terminal.show_json(asked | made_by() | _as_json(verdict))
        return ExitCode.of(verdict.proved)
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
        rows += [("", _words(place)) for place in verdict.open_places[:8]]
    if out is not None:
        rows.append(("picture", str(out)))
    terminal.show([terminal.table("proof", ("", ""), rows)])
    return ExitCode.of(verdict.proved)


def _as_json(verdict: "ReachVerdict") -> dict[str, object]:
    return {
        "proved_unreachable": verdict.proved,
        "boxes": verdict.boxes,
        "share_ruled_out": verdict.share_ruled_out,
        "finished": verdict.finished,
        "rests_on": verdict.rests_on,
        "open_place_lps_mm": None if verdict.open_lps is None else verdict.open_lps.tolist(),
        "open_places": [
            {
                "branch": place.branch,
                "generation": place.generation,
                "name": place.name,
                "share": place.share,
                "narrowest": place.narrowest,
                "tip_lps_mm": place.tip_lps.tolist(),
                "insertions_mm": list(place.insertions_mm),
            }
            for place in verdict.open_places
        ],
    }


def _percent(share: float) -> str:
    """Return a share in percent, with as many digits as tell it from all of it."""
    for digits in (1, 3, 6):
        if share == 1.0 or round(100.0 * share, digits) < 100.0:
            return f"{100.0 * share:.{digits}f} %"
    return "all but a millionth of a percent"


def _words(place: "OpenPlace") -> str:
    from anatomy.display import point

    return (
        f"branch {place.name}, generation {place.generation}, from {point(place.tip_lps)} (LPS mm): "
        f"{100.0 * place.share:.2g} % of the space"
    )
