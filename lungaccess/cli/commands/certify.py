"""The command `lungaccess certify`: proof that a target is out of a system's reach."""

from __future__ import annotations

from pathlib import Path

from anatomy.errors import SettingsError
from anatomy.io.frames import parse_point
from lungaccess.cli import terminal
from lungaccess.cli.inputs import load_device, load_lung, require_one_target
from lungaccess.cli.progress import progress

PROVED, NOT_PROVED = 0, 1


def certify(
    patient: Path,
    *,
    target: str | None = None,
    nodule: int | None = None,
    system: str = "lung-default",
    allow_fissures: bool | None = None,
    most_boxes: int | None = None,
    json: bool = False,
    cache: Path | None = None,
) -> int:
    """Prove that a target is unreachable: from no place in the airways, however scope and tubes are turned.

    Exit code 0 if it is proved, 1 if it is not: then nothing is known.

    Parameters
    ----------
    patient : Path
        Folder of masks.
    target : str
        Point in mm with its frame: ras:x,y,z or lps:x,y,z.
    nodule : int
        The centre of this nodule of the nodule mask.
    system : str
        Preset or TOML file.
    allow_fissures : bool
        Whether fissures may be crossed; as the system says if not given.
    most_boxes : int
        Ranges of deployments to look at for every 8 mm of airway before the proof is given up; 3 million if
        not given.
    json : bool
        Print JSON instead of a table.
    cache : Path
        Folder where the prepared anatomy is kept for the next command.
    """
    from lungaccess.problem.target import nodule_target
    from lungaccess.reachability.unreachable import MOST_BOXES, UnreachableProof

    require_one_target(target, nodule)
    if most_boxes is not None and most_boxes < 1:
        raise SettingsError(f"--most-boxes is {most_boxes}", expected="at least 1")
    device = load_device(system, allow_fissures)
    lung = load_lung(patient, cache)
    point = parse_point(target) if target is not None else nodule_target(lung, nodule or 1).lps_mm
    with progress("proving") as shown:
        proof = UnreachableProof(lung, device, with_fissures=not device.fissures_allowed)
        verdict = proof.prove(
            point, most_boxes=most_boxes or MOST_BOXES, progress=lambda share: shown.step("proving", share)
        )
    open_lps = None if verdict.open_lps is None else verdict.open_lps.tolist()
    if json:
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
        return PROVED if verdict.proved else NOT_PROVED
    rows = [
        ("system", device.name),
        ("outcome", "proved unreachable" if verdict.proved else "not proved: it may be reachable or not"),
        ("ranges of deployments looked at", f"{verdict.boxes:,}"),
    ]
    if open_lps is not None:
        rows.append(("not ruled out from", ", ".join(f"{value:.1f}" for value in open_lps) + " (LPS mm)"))
    terminal.show([terminal.table("proof", ("", ""), rows)])
    return PROVED if verdict.proved else NOT_PROVED
