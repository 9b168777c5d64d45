"""The command `lungaccess certify`: proof that a target is out of a system's reach."""

from __future__ import annotations

from lungaccess.cli import terminal
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.numbers import Count
from lungaccess.cli.options import PatientFolder, PatientOptions, SystemOptions, TargetOptions
from lungaccess.cli.progress import progress


def certify(
    patient: PatientFolder,
    *,
    target: TargetOptions = TargetOptions(),
    system: SystemOptions = SystemOptions(),
    most_boxes: Count | None = None,
    output: PatientOptions = PatientOptions(),
) -> ExitCode:
    """Prove that a target is unreachable: from no place in the airways, however scope and tubes are turned.

    Exit code 0 if it is proved, 1 if it is not: then nothing is known.

    Parameters
    ----------
    most_boxes : int
        Ranges of deployments to look at for every 8 mm of airway before the proof is given up; 3 million if
        not given.
    """
    from lungaccess.reachability import MOST_BOXES, UnreachableProof

    stated = target.stated()
    device = system.load()
    lung = output.load(patient)
    point = stated.centre_lps(lung)
    with progress("proving") as shown:
        proof = UnreachableProof(lung, device, with_fissures=not device.fissures_allowed)
        verdict = proof.prove(
            point, most_boxes=most_boxes or MOST_BOXES, progress=lambda share: shown.step("proving", share)
        )
    open_lps = None if verdict.open_lps is None else verdict.open_lps.tolist()
    if output.json:
        terminal.show_json(
            {
                "patient": lung.name,
                "system": device.name,
                "target_lps_mm": point.tolist(),
                "proved_unreachable": verdict.proved,
                "boxes": verdict.boxes,
                "open_place_lps_mm": open_lps,
            }
        )
        return ExitCode.of(verdict.proved)
    rows = [
        ("system", device.name),
        ("outcome", "proved unreachable" if verdict.proved else "not proved: it may be reachable or not"),
        ("ranges of deployments looked at", f"{verdict.boxes:,}"),
    ]
    if open_lps is not None:
        rows.append(("not ruled out from", ", ".join(f"{value:.1f}" for value in open_lps) + " (LPS mm)"))
    terminal.show([terminal.table("proof", ("", ""), rows)])
    return ExitCode.of(verdict.proved)
