"""The patients of a study, as any process on any machine opens them."""

from functools import lru_cache
from pathlib import Path

from anatomy.base.errors import FileError
from anatomy.base.records import frozen_value
from anatomy.build import lung_key
from anatomy.lung import Lung
from anatomy.patient import PatientImages
from lungaccess.running.study.settings import PHANTOM, Case, PhantomPatient


@frozen_value
class Patient:
    """A patient by content, and where to read it where no cache holds it.

    Args:
        anatomy: "phantom", or an absolute folder.
        spacing_mm: Of the synthetic patient.
        sources (tuple of (str, str)): Name and SHA-256 of every input.
    """

    anatomy: str
    seed: int
    size: str
    spacing_mm: float | None
    sources: tuple[tuple[str, str], ...]

    @property
    def key(self) -> str:
        """Key of the lung made from these inputs."""
        return lung_key(dict(self.sources))


def patient_of(case: Case, folder: Path, cache: Path | None = None) -> Patient:
    """Return the patient of a case; a relative folder is relative to `folder`.

    Raises:
        LungaccessError: If the patient cannot be read.
    """
    from anatomy.io.inputs import input_hashes

    made = case.phantom
    if case.anatomy == PHANTOM:
        place, sources = PHANTOM, _phantom_sources(made)
    else:
        place = str((folder / case.anatomy).resolve())
        sources = input_hashes(Path(place))
    return Patient(
        anatomy=place,
        seed=made.seed,
        size=made.size,
        spacing_mm=made.spacing_mm,
        sources=tuple(sorted(sources.items())),
    )


def open_patient(patient: Patient, cache: Path | None = None) -> Lung:
    """Return the lung of a patient, from the cache or newly built.

    Raises:
        FileError: If what is read is not what the study was set up with.
        LungaccessError: If the patient cannot be read.
    """
    from anatomy.store import open_lung

    return open_lung(dict(patient.sources), lambda: _read(patient), cache=cache, accept=())


def _read(patient: Patient) -> PatientImages:
    from anatomy.io.inputs import input_hashes
    from anatomy.io.patients import load_patient

    if patient.anatomy == PHANTOM:
        images = _phantom_images(
            PhantomPatient(seed=patient.seed, size=patient.size, spacing_mm=patient.spacing_mm)  # type: ignore[arg-type]
        )
        found = dict(images.sources)
    else:
        images, found = load_patient(Path(patient.anatomy)), input_hashes(Path(patient.anatomy))
    if found != dict(patient.sources):
        raise FileError(
            f"The files of {patient.anatomy} differ from those the study began with",
            expected="the same files on every machine",
            remedy="Copy the patient's folder again, and start the study once more",
        )
    return images


@lru_cache(maxsize=16)
def _phantom_sources(made: PhantomPatient) -> dict[str, str]:
    return dict(_phantom_images(made).sources)


def _phantom_images(made: PhantomPatient) -> PatientImages:
    from anatomy.phantom import make_phantom

    return make_phantom(seed=made.seed, spacing_mm=made.spacing_mm, size=made.size).images
