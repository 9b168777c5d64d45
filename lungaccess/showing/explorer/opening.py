"""From a folder of this machine to a patient that is explored: its series, its CT segmented, its nodules.

Every answer says in words what was found and how it goes on.  What a person may overrule is a question with
its consequence, and never done in silence.
"""

import math
import re
import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from anatomy.base.errors import AnatomyError, FileError, LungaccessError, SettingsError
from anatomy.base.files import read_json, require_writable_folder
from anatomy.base.typed import Float, Float32, UInt8
from anatomy.base.unfinished import MARK, sole_writer
from anatomy.grid import Volume
from anatomy.io.dicom import SeriesInfo, list_series
from anatomy.io.images import image_suffix
from anatomy.io.own_masks import require_thin_slices
from anatomy.io.patients import is_ct
from anatomy.lung import Lung
from anatomy.plausibility import CHECKS
from anatomy.segmentation.folder import STATE
from anatomy.segmentation.input import THICK_SLICE_MM
from anatomy.segmentation.outlining import outline_nodule
from anatomy.segmentation.request import Given, SegmentationRequest
from anatomy.structures import OUTSIDE, VESSEL
from lungaccess.problem import load_patient
from lungaccess.problem.nodules import nodules_of
from lungaccess.showing.explorer.questions import LookQuestion, OpenQuestion
from lungaccess.showing.explorer.worker import Part, PatientSource, Turn
from lungaccess.showing.report.html.volumes import find_ct, resampled
from lungaccess.showing.report.segmented import (
    PICTURE,
    REFUSED_PICTURE,
    Segmented,
    patient_folder,
    segment_with_pictures,
)

MOST_ENTRIES = 1000
"""Folders and files that a page lists; of more the first by name are shown."""
CHEST_MM = 150.0
"""A series that covers less of the body holds no whole lung."""
PICTURE_PIXELS = 160
WINDOW_HU = (-1100.0, 250.0)
OUTLINE_MM = 45.0
"""The outliner looks at no more than 40 mm around a point."""


def looked(question: LookQuestion) -> Part:
    """Return what lies in a folder: its folders, and the images in it; where none is named, in this one.

    Raises FileError if there is no such folder, or it cannot be read.
    """
    path = _path(question.path)
    folder = path if path.is_dir() else path.parent
    try:
        entries = sorted(each for each in folder.iterdir() if not each.name.startswith("."))
        folders = [each.name for each in entries if each.is_dir()]
    except OSError as error:
        raise FileError(
            f"{folder} cannot be read: {error.strerror}",
            expected="a folder of this machine",
            remedy="Choose another one",
        ) from error
    files = [each.name for each in entries if each.name not in folders and image_suffix(each)]
    return Part(
        {
            "answer": "folder", "path": str(folder), "parent": str(folder.parent),
            "folders": folders[:MOST_ENTRIES], "files": files[:MOST_ENTRIES],
            "left_out": max(len(folders), len(files)) > MOST_ENTRIES,
        }
    )  # fmt: skip


def opened(question: OpenQuestion, source: PatientSource, folder: Path, turn: Turn) -> Iterator[Part]:
    """Yield the series of a CT, or the masks made from it, or the patient that is explored from now on.

    Raises LungaccessError if it is no CT and no patient, and nothing that a person may accept helps.

    Args:
        source: What the explorer was started with.
        folder: Where pictures for the page are written.
    """
    path = _path(question.path)
    try:
        if is_ct(path):
            yield from _segmented(path, question, folder, turn)
            return
        turn.tell("reading the patient")
        if not question.thick_slices:
            require_thin_slices(path)
        yield _exploring(path, replace(source, accept=(*source.accept, *question.accept)), turn)
    except (AnatomyError, SettingsError) as error:
        names = [name for name in re.findall(r"--accept ([\w-]+)", error.remedy) if name in CHECKS]
        thick = "--thick-slices" in error.remedy and not question.thick_slices
        if not (names or thick):
            raise
        drawn = patient_folder(path, question.series or None) / REFUSED_PICTURE
        yield Part(
            {
                "answer": "refused", "found": error.found, "expected": error.expected,
                "accept": [*question.accept, *names], "thick_slices": thick or question.thick_slices,
            },
            file=_copied(drawn, folder) if is_ct(path) else None,
        )  # fmt: skip


def _segmented(path: Path, question: OpenQuestion, folder: Path, turn: Turn) -> Iterator[Part]:
    """Yield the series of a folder if one is to be chosen, else the masks of the CT."""
    from anatomy.segmentation.pipeline import read_ct

    series = question.series or None
    if path.is_dir() and series is None:
        turn.tell("reading the series")
        found = list_series(path)
        if len(found) > 1:
            yield from _series_parts(found)
            return
    turn.tell("reading the CT", 0.0)
    volume, sources = read_ct(path, series)
    request = SegmentationRequest(
        ct=volume, out=patient_folder(path, series).resolve(), sources=sources, ct_path=path,
        ct_series=series, thick_slices=question.thick_slices, accept=question.accept,
    )  # fmt: skip
    made = _made(request, turn, folder)
    warnings = [_words_of_page(each) for each in made.warnings]
    yield Part(
        {"answer": "segmented", "folder": str(request.out), "warnings": warnings},
        file=_copied(request.out / PICTURE, folder),
    )


def _series_parts(found: tuple[SeriesInfo, ...]) -> Iterator[Part]:
    """Yield each series with its picture, and whether it is proposed; of several patients none is."""
    patients = sorted({each.patient for each in found})
    best = max(found, key=_fitness) if len(patients) == 1 else None
    for each in sorted(found, key=_fitness, reverse=True):
        try:
            picture = _bytes_of(each.picture_hu())
        except LungaccessError:
            picture = np.zeros((1, 1, 4), dtype=np.uint8)
        whose = f", patient {patients.index(each.patient) + 1} of {len(patients)}" if best is None else ""
        slices = f"{len(each.paths)} slices, {each.slice_mm:.1f} mm apart, {each.length_mm:.0f} mm long"
        yield Part(
            {
                "answer": "series", "uid": each.uid, "proposed": each is best,
                "shape": list(picture.shape[:2]),
                "words": f"{each.description or 'without a name'} ({each.modality}){whose}: {slices}",
            },
            {"picture": picture},
        )  # fmt: skip


def _fitness(series: SeriesInfo) -> tuple[bool, bool, bool, float, int]:
    """Return what makes a series fit: a CT of a whole lung, not in thick slices, in thin ones, in many."""
    whole, known = series.length_mm >= CHEST_MM, series.slice_mm > 0.0
    thin = known and series.slice_mm <= THICK_SLICE_MM
    return series.modality == "CT", whole, thin, -series.slice_mm if known else -math.inf, len(series.paths)


def _bytes_of(hu: Float32) -> UInt8:
    """Return a small picture in red, green, blue and opacity of a slice."""
    step = max(1, -(-max(hu.shape) // PICTURE_PIXELS))
    low, high = WINDOW_HU
    grey = np.clip((hu[::step, ::step] - low) / (high - low), 0.0, 1.0) * 255.0
    picture = np.full((*grey.shape, 4), 255, dtype=np.uint8)
    picture[..., :3] = grey.astype(np.uint8)[..., None]
    return picture


def _exploring(path: Path, source: PatientSource, turn: Turn) -> Part:
    """Return the part after which a patient is explored; it is prepared and kept here, with its progress."""
    ct = find_ct(path)
    if ct is not None and ct.path.exists():
        ct.read()  # Here, where a file that is none is refused before anything is shown.
    else:
        ct = None
    lung = load_patient(path, cache=source.cache, accept=source.accept, progress=turn.tell)
    made = replace(source, folder=path, ct=ct)
    return Part({"answer": "opened", "patient": lung.name, "target": ""}, source=made)


def outlined(lung: Lung, ct: Volume, point_lps: Float) -> tuple[Lung, dict[str, Any]]:
    """Outline the nodule at a point at once.

    Raises AnatomyError if there is no nodule that can be told from vessels and chest wall.

    Returns:
        - Lung - What lies around it as slices show it, with this nodule alone; nothing is planned on it.
        - dict - The volume in ml, and the diameter in mm of the ball with that volume.
    """
    box = lung.grid.window(point_lps + np.array([[-OUTLINE_MM], [OUTLINE_MM]]), 0.0)
    grid = lung.grid.crop([each.start for each in box], [each.stop for each in box])
    around = Volume(grid=grid, array=resampled(ct, grid, 1, -1024.0).astype(np.float32))
    try:
        inside = outline_nodule(around, (lung.labels[box] & OUTSIDE) == 0, point_lps)
    except AnatomyError as error:
        remedy = 'Put the cross into its middle, or paint it under "Mend the masks"'
        raise AnatomyError(error.found, expected=error.expected, remedy=remedy) from error
    labels = np.array(lung.labels[box], order="F")
    labels[inside] &= ~np.array(OUTSIDE | VESSEL, dtype=labels.dtype)
    volume_mm3 = float(np.count_nonzero(inside)) * grid.voxel_volume_mm3
    nodule = Volume(grid=grid, array=inside)
    others: dict[str, Any] = dict.fromkeys(("cost", "lobes", "fissure_band", "nodule_labels"))
    shown = replace(lung, grid=grid, labels=labels, fields={}, nodules=nodule, **others)
    size = {"volume_ml": volume_mm3 / 1000.0, "diameter_mm": (6.0 * volume_mm3 / math.pi) ** (1.0 / 3.0)}
    return shown, size


def with_nodule(point_lps: Float, source: PatientSource, turn: Turn) -> Part:
    """Segment a patient again with one more nodule, and return the part after which it is explored.

    Raises:
        SettingsError: If the folder was not segmented here, or from masks of others, or if a corrected mask
            takes the place of the new nodule.
        LungaccessError: As `anatomy.segmentation.pipeline.segment`.
    """
    from anatomy.segmentation.pipeline import read_ct

    folder, ct = source.patient, source.ct
    made = _segmentation_record(folder)
    if made is None or ct is None or made["given_files"]:
        raise SettingsError(
            f"{folder} was not made from a CT by this program alone",
            expected="a folder of `lungaccess segment` without masks of others",
            remedy="Give the nodule with `lungaccess segment --nodule`, or plan to the point",
        )
    point = f"lps:{','.join(f'{value:.2f}' for value in point_lps)}"
    volume, sources = read_ct(ct.path, ct.series)
    seed = made["seed_lps"]
    request = SegmentationRequest(
        ct=volume, out=folder, sources=sources, ct_path=ct.path, ct_series=ct.series,
        ex_vivo=made["ex_vivo"], thick_slices=made["thick_slices"], large_radius_mm=made["large_radius_mm"],
        accept=tuple(made["accepted"]), seed_lps=None if seed is None else np.array(seed),
        voxel_mm=made["voxel_mm"], given=Given(nodules=(*made["nodules"], point)),
    )  # fmt: skip
    _made(request, turn, None)
    part = _exploring(folder, source, turn)
    number = nodule_near(load_patient(folder, cache=source.cache, accept=source.accept), point_lps)
    if number is None:
        raise SettingsError(
            f"The nodules of {folder} have none at {point} after the segmentation",
            expected="no corrected mask of nodules, which takes the place of what is found",
            remedy="Add the nodule to that mask, or take the mask away",
        )
    part.message["target"] = f"nodule {number}"
    return part


def nodule_near(lung: Lung, point_lps: Float) -> int | None:
    """Return the number of the nodule nearest to a point; None if all are farther than 3 mm away."""
    # The outline of a nodule may leave out the voxel that was pointed at, at its border.
    near = [
        (float(np.linalg.norm(lung.grid.lps(each.voxels) - point_lps, axis=1).min()), each.number)
        for each in nodules_of(lung)
    ]
    away_mm, number = min(near, default=(np.inf, 0))
    return number if away_mm <= 3.0 else None


def _segmentation_record(folder: Path) -> dict[str, Any] | None:
    """Return with what a folder was segmented; None if it was not.

    Raises FileError if the record is damaged.
    """
    if not (folder / STATE).is_file():
        return None
    record = read_json(folder / STATE, expected="the record of a segmentation", remedy="Segment the CT again")
    provenance = record.get("provenance") if isinstance(record, dict) else None
    return {"nodules": [], **provenance} if isinstance(provenance, dict) else None


def _path(text: str) -> Path:
    """Return the path that a person means."""
    path = Path(text or ".").expanduser().resolve()
    if not path.exists():
        raise FileError(
            f"There is no {path}",
            expected="a folder or file of this machine",
            remedy="Choose one of the list",
        )
    return path


def _words_of_page(warning: str) -> str:
    """Return a warning as the page has its remedy: options of a command are none of a person's there."""
    place = re.sub(r"add --nodule (\S+?)\.$", r"put the cross to \1 and outline it.", warning)
    return place.replace("in segmentation.png", "in the pictures below")


def _made(request: SegmentationRequest, turn: Turn, folder: Path | None) -> Segmented:
    """Segment, alone in the folder, and tell the page each step; it ends when the page is gone.

    Lungs and airway are shown as soon as they are made, if pictures have a folder.
    """

    def begun(picture: Path) -> None:
        step = {"answer": "begun", "words": "Lungs and airway are made; vessels, lobes and fissures follow."}
        turn.send(Part(step, file=None if folder is None else _copied(picture, folder)))

    def tell(step: str, share: float | None) -> None:
        turn.check()
        turn.tell(step, share)

    mark = require_writable_folder(request.out) / MARK
    mark.mkdir(exist_ok=True)
    with sole_writer(request.out, mark):
        return segment_with_pictures(request, tell, begun=None if folder is None else begun)


def _copied(picture: Path, folder: Path) -> Path | None:
    """Return a copy that may be sent and removed."""
    if not picture.is_file():
        return None
    return Path(shutil.copy(picture, tempfile.mkdtemp(dir=folder)))
