"""Masks mended by hand: each stroke becomes voxels, kept with the patient, and its lung is renewed."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from anatomy.base.errors import LungaccessError, SettingsError
from anatomy.base.typed import Float32, Mask, UInt8
from anatomy.build import Reused
from anatomy.corrections import PAINTED, ROLES, TISSUE
from anatomy.grid import Volume
from anatomy.io.corrections import corrected, corrections_file, read_corrections, write_corrections
from anatomy.io.masks import place
from anatomy.io.patients import load_patient
from anatomy.lung import Lung
from anatomy.morphology import Window
from anatomy.patient import PatientImages
from anatomy.strokes import Stroke, meant_voxels
from lungaccess.problem.patients import renewed_patient
from lungaccess.showing.explorer.questions import PaintQuestion
from lungaccess.showing.explorer.worker import PatientSource
from lungaccess.showing.report.html.volumes import resampled

MOST_UNDONE = 50
"""So many strokes can be taken back."""
ERASING = ("erase", "cut")


@dataclass
class Painting:
    """The masks of a patient while a person corrects them.

    Args:
        made: The images without corrections.
        values: What was corrected, on the voxels of the images.
        undone: What strokes painted over, the last one last.
    """

    source: PatientSource
    made: PatientImages
    images: PatientImages
    values: UInt8
    reused: Reused
    undone: list[tuple[Window, UInt8]] = field(default_factory=list)

    @classmethod
    def of(cls, source: PatientSource, lung: Lung) -> "Painting":
        """Return the masks of a patient, ready to be corrected.

        Raises LungaccessError as `anatomy.io.load_patient`.
        """
        made = load_patient(source.patient, as_made=True)
        values = np.zeros(made.grid.shape, dtype=np.uint8, order="F")
        file = corrections_file(source.patient)
        if file.is_file():
            kept = read_corrections(file)
            values = place(kept.array, kept.grid, made.grid).array
        images = corrected(made, source.patient)
        return cls(source=source, made=made, images=images, values=values, reused=Reused(images, lung))

    def draw(self, question: PaintQuestion, ct: Callable[[], Volume]) -> float:
        """Correct what a stroke means, and return how many ml it changes; a fill and a bridge need the CT.

        Raises SettingsError if the stroke means nothing, or there is none to be taken back.
        """
        if question.tool == "undo":
            return self._undo()
        grid = self.made.grid

        def hu_at(box: Window) -> Float32:
            part = grid.crop([axis.start for axis in box], [axis.stop for axis in box])
            return np.asarray(resampled(ct(), part, 1, -1024.0), dtype=np.float32)

        stroke = Stroke(
            tool=question.tool, points_lps=np.array(question.points), radius_mm=question.radius_mm,
            normal_lps=None if question.normal is None else np.array(question.normal),
            level_hu=question.level_hu,
        )  # fmt: skip
        if question.structure == "fissure" and self.made.fissures is None:
            raise SettingsError(
                "The patient came without fissures, and a few that are painted would count as all",
                expected="a structure that the patient has",
                remedy="Paint what a needle must not cross as a vessel",
            )
        box, mask = meant_voxels(stroke, grid, self._structure(question), hu_at)
        code = TISSUE if question.tool in ERASING else PAINTED[question.structure]
        before = self.values[box].copy()
        changed = mask & (before != code)
        if not changed.any():
            raise SettingsError(
                f"There is no {question.structure} to change there",
                remedy="Paint elsewhere, or another structure",
            )
        self.undone = [*self.undone[1 - MOST_UNDONE :], (box, before)]
        self.values[box] = np.where(mask, np.uint8(code), before)
        return float(np.count_nonzero(changed)) * grid.voxel_volume_mm3 / 1000.0

    def _undo(self) -> float:
        if not self.undone:
            raise SettingsError("No stroke is left to be taken back", remedy="Erase or paint")
        box, before = self.undone.pop()
        changed = np.count_nonzero(self.values[box] != before)
        self.values[box] = before
        return float(changed) * self.made.grid.voxel_volume_mm3 / 1000.0

    def _structure(self, question: PaintQuestion) -> Mask:
        """Return the structure as it is now; what is erased of an airway is also its wall."""
        images = self.images
        volume: Volume | None = getattr(images, ROLES[question.structure])
        if volume is None:
            return np.zeros(self.made.grid.shape, dtype=np.bool_, order="F")
        if question.structure == "airway" and question.tool == "erase" and images.wall is not None:
            return np.asarray(volume.array | images.wall.array)
        return volume.array

    def renewed(self, tell: Callable[[str], Any]) -> Lung:
        """Keep the corrections with the patient, and return its lung as it now is.

        Raises LungaccessError if the masks can no longer be those of a patient: the stroke is taken back.
        """
        file = corrections_file(self.source.patient)
        write_corrections(file, Volume(grid=self.made.grid, array=self.values))
        before, self.images = self.images, corrected(self.made, self.source.patient)
        try:
            return renewed_patient(
                self.source.patient, self.images, self.reused, cache=self.source.cache,
                accept=self.source.accept, progress=tell,
            )  # fmt: skip
        except LungaccessError:
            self.images = before
            self._undo()
            write_corrections(file, Volume(grid=self.made.grid, array=self.values))
            raise
