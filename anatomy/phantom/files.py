"""Write a phantom as a patient folder that `anatomy.io.load_patient` reads."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from anatomy.base.files import require_writable_folder, write_text
from anatomy.grid import Volume
from anatomy.io.images import write_volume
from anatomy.io.motion_files import write_vectors
from anatomy.io.own_masks import DESCRIPTION
from anatomy.phantom.branching import Centerlines
from anatomy.phantom.breathing import PhantomBreathing
from anatomy.phantom.chest import LOBES
from anatomy.phantom.patient import Phantom
from anatomy.phantom.rasterize import LABELS

MOTION_FILE = "motion.nrrd"


def write_phantom(
    phantom: Phantom, folder: str | Path, *, breathing: bool = False, with_ct: bool = True
) -> Path:
    """Write masks, `patient.toml`, CT and the truth of a phantom into `folder`, which is made if needed.

    `lumen`, `wall`, `vessels`, `lung`, `fissures`, `nodules`, `ct`, `labels` and `lobes` become NIfTI
    images; `truth.json` holds the centrelines, the nodules and the meaning of the labels (LPS mm).
    Without `with_ct` there is no CT, which takes most of the room.  With `breathing` there is `motion.nrrd`
    as well, and `patient.toml` names it.  `patient.toml` is written last, so that a folder that has it is
    complete.

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    FileError
        If the folder cannot be written to.
    """
    folder = require_writable_folder(folder)
    images = phantom.images
    volumes: dict[str, Volume | None] = {
        "lumen": images.lumen,
        "wall": images.wall,
        "vessels": images.vessels,
        "lung": images.lung,
        "fissures": images.fissures,
        "nodules": images.nodules,
        "ct": phantom.ct if with_ct else None,
        "labels": phantom.labels,
        "lobes": phantom.lobes,
    }
    for name, volume in volumes.items():
        if volume is not None:
            write_volume(folder / f"{name}.nii.gz", volume)
    truth, lines = _truth(phantom), _description(phantom)
    if breathing:
        motion = PhantomBreathing.of(phantom)
        write_vectors(folder / MOTION_FILE, *motion.field(phantom))
        truth["breathing"] = asdict(motion)
        lines += f'\n[motion]\nfile = "{MOTION_FILE}"\nmaps_from = "end-exhale"\nmasks_phase = 1.0\n'
    write_text(folder / "truth.json", json.dumps(truth))
    write_text(folder / DESCRIPTION, lines)
    return folder


def _description(phantom: Phantom) -> str:
    points = [",".join(repr(float(x)) for x in nodule.centre_lps) for nodule in phantom.nodules]
    targets = ", ".join(f'"lps:{point}"' for point in points)
    lines = [
        f'name = "{phantom.images.name}"',
        f'breath_hold = "{phantom.images.breath_hold}"',
        *(f'{key} = "{key}.nii.gz"' for key in ("lumen", "wall", "vessels", "lung", "fissures")),
        'nodule = "nodules.nii.gz"',
        f"targets = [{targets}]",
    ]
    return "\n".join(lines) + "\n"


def _truth(phantom: Phantom) -> dict[str, Any]:
    return {
        "seed": phantom.seed,
        "size": phantom.size,
        "traits": asdict(phantom.traits),
        "frame": "lps",
        "labels": LABELS,
        "lobes": LOBES,
        "nodules": [
            {"centre_lps": n.centre_lps.tolist(), "radius_mm": n.radius_mm, "lobe": n.lobe}
            for n in phantom.nodules
        ],
        "bullae": [{"centre_lps": b.centre_lps.tolist(), "radius_mm": b.radius_mm} for b in phantom.bullae],
        "centerlines": {kind: _tree(lines) for kind, lines in phantom.centerlines.items()},
    }


def _tree(lines: Centerlines) -> dict[str, Any]:
    return {
        "points_lps": lines.points_lps.round(4).tolist(),
        "radius_mm": lines.radius_mm.round(4).tolist(),
        "outer_radius_mm": lines.outer_radius_mm.round(4).tolist(),
        "branch_start": lines.branch_start.tolist(),
        "branch_parent": lines.branch_parent.tolist(),
        "generation": lines.generation.tolist(),
        "horsfield_order": lines.horsfield_order.tolist(),
        "strahler_order": lines.strahler_order.tolist(),
        "lobe": lines.lobe.tolist(),
        "names": list(lines.names),
    }
