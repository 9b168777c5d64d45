"""Every reader of files that a user names: an intact file, and how it is read."""

from __future__ import annotations

import gzip
import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import SimpleITK

from anatomy.grid import Grid, Volume
from anatomy.io.images import read_mask, read_volume
from tests.anatomy.io.series import write_series

_CONTOURED = Grid.from_spacing((512, 512, 40), [0.7, 0.7, 1.0], [-180.0, -180.0, -540.0])
GRID = Grid.from_spacing((12, 10, 8), [5.0, 4.0, 2.0], [-30.0, -20.0, 10.0])


@dataclass(frozen=True)
class Target:
    """A file to damage and how to read it.

    Args:
        file: Name of the damaged file in the folder.
        make: Writes intact files into a folder.
        read: Given the folder; raises typed errors alone.
        header_bytes: How many bytes of the content come before the voxels.  Damage to them that leaves the
            grid as it is must leave the voxels as they are.
    """

    file: str
    make: Callable[[Path], None]
    read: Callable[[Path], Any]
    header_bytes: Callable[[bytes], int] | None = None


def _voxels() -> np.ndarray:
    return np.random.default_rng(5).integers(0, 4, GRID.shape).astype(np.int16)


def _image(name: str, compressed: bool) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        image = SimpleITK.GetImageFromArray(_voxels().T)
        image.SetSpacing(GRID.spacing_mm.tolist())
        image.SetOrigin(GRID.lps_from_ijk[:3, 3].tolist())
        SimpleITK.WriteImage(image, str(folder / name), useCompression=compressed)

    return make


def _image_target(name: str, header: Callable[[bytes], int] | None, compressed: bool = False) -> Target:
    def read(folder: Path) -> Volume:
        read_mask(folder / name, role="lung")
        return read_volume(folder / name)

    return Target(file=name, make=_image(name, compressed), read=read, header_bytes=header)


def _corrections_target() -> Target:
    """Return what a person painted, whose values say what a voxel is."""

    def read(folder: Path) -> Volume:
        from anatomy.io.corrections import read_corrections

        return read_corrections(folder / "painted.nii.gz")

    return Target(file="painted.nii.gz", make=_image("painted.nii.gz", True), read=read)


def _field_target(name: str, header: Callable[[bytes], int] | None) -> Target:
    """Return a displacement field; what is read of it is one number for each vector."""

    def make(folder: Path) -> None:
        from anatomy.io.motion_files import write_vectors

        write_vectors(folder / name, GRID, np.stack([_voxels() + n for n in range(3)], axis=-1))

    def read(folder: Path) -> Volume:
        from anatomy.io.motion_files import read_vectors

        grid, vectors = read_vectors(folder / name)
        return Volume(grid=grid, array=vectors[..., 0])

    return Target(file=name, make=make, read=read, header_bytes=header)


def _after(mark: bytes) -> Callable[[bytes], int]:
    return lambda content: content.index(mark) + len(mark)


def _before_pixels(content: bytes) -> int:
    return content.index(b"\xe0\x7f\x10\x00")


def _series(folder: Path) -> None:
    write_series(folder / "ct", Volume(grid=GRID, array=_voxels()))
    (folder / "ct" / "1-0.dcm").rename(folder / "slice.dcm")


def _read_series(folder: Path) -> Any:
    from anatomy.io.dicom import list_series, read_dicom

    (folder / "slice.dcm").replace(folder / "ct" / "1-0.dcm")
    list_series(folder / "ct")
    return read_dicom(folder / "ct")


def _centerlines(folder: Path) -> None:
    from tests.anatomy.io.test_centerlines import _write

    _write(folder / "a.vtp")
    _write(folder / "b.vtp", "raw", "UInt64", compress=True)
    _write(folder / "c.vtu", "binary")


def _read_centerlines(name: str) -> Callable[[Path], Any]:
    from anatomy.io.centerlines import read_centerline_graph, read_centerlines

    def read(folder: Path) -> Any:
        return read_centerline_graph(folder / name), read_centerlines(folder / name)

    return read


def _transform(folder: Path) -> None:
    transform = SimpleITK.AffineTransform(3)
    transform.SetTranslation((1.5, -2.0, 12.0))
    transform.SetCenter((3.0, 4.0, 5.0))
    SimpleITK.WriteTransform(transform, str(folder / "a.tfm"))


def _markups(folder: Path) -> None:
    places = [[1.5, -20.0, 30.0], [1.5, -20.0, -31.0]]
    points = [{"label": f"p-{n}", "position": place, "orientation": [1, 0, 0, 0, 1, 0, 0, 0, 1]}
              for n, place in enumerate(places)]  # fmt: skip
    markup = {"type": "Fiducial", "coordinateSystem": "LPS", "coordinateUnits": "mm", "controlPoints": points}
    (folder / "p.mrk.json").write_text(json.dumps({"markups": [markup]}))


def _template(name: str) -> Callable[[Path], None]:
    text = (resources.files("lungaccess") / "cli" / "templates" / name).read_bytes()
    return lambda folder: (folder / name).write_bytes(text) and None


def _text_targets() -> dict[str, Target]:
    from anatomy.io.frames import read_points, read_pose
    from anatomy.io.markups import read_markups
    from anatomy.io.motion_files import read_landmarks, read_transform
    from anatomy.io.own_masks import _read_description, thick_slices_mm
    from anatomy.io.totalsegmentator import stored_names
    from anatomy.segmentation.nodules import nodule_from_contours
    from lungaccess.planning.one_stage.tubes import load_tubes
    from lungaccess.planning.tour import read_lesions
    from lungaccess.plans.plan import Plan
    from lungaccess.problem.error_files import load_errors
    from lungaccess.problem.procedures import load_procedure
    from lungaccess.problem.system import load_system
    from lungaccess.running.design.settings import read_design
    from lungaccess.running.study.settings import read_study
    from tests.lungaccess.conftest import make_plan

    def preset(folder: Path) -> None:
        text = (resources.files("lungaccess.problem") / "presets" / "ultrathin.toml").read_bytes()
        (folder / "system.toml").write_bytes(text)

    def description(folder: Path) -> Any:
        return _read_description(folder / "patient.toml"), thick_slices_mm(folder)

    def points(folder: Path) -> None:
        (folder / "points.txt").write_text("1.5 -20 30\n-4e1 5 -6.25\n")

    def pairs(folder: Path) -> None:
        (folder / "pairs.csv").write_text("x,y,z,x,y,z\n1.5,-20,30,1.6,-21,36\n-4e1,5,-6.25,-40,6.5,-6\n")

    def labelled(folder: Path) -> None:
        _image("labels.nii.gz", True)(folder)
        (folder / "labels.json").write_text('{"labels": {"lung_airways": 1, "lung_vessels": 2}}')

    return {
        "patient": Target("patient.toml", _template("patient.toml"), description),
        "system": Target("system.toml", preset, lambda f: load_system(f / "system.toml")),
        "errors": Target("errors.toml", _template("errors.toml"), lambda f: load_errors(f / "errors.toml")),
        "procedure": Target(
            "procedure.toml", _template("procedure.toml"), lambda f: load_procedure(f / "procedure.toml")
        ),
        "study": Target("study.toml", _template("study.toml"), lambda f: read_study(f / "study.toml")),
        "design": Target("design.toml", _template("design.toml"), lambda f: read_design(f / "design.toml")),
        "tubes": Target("tubes.toml", _template("tubes.toml"), lambda f: load_tubes(f / "tubes.toml")),
        "pose": Target("pose.txt", _template("pose.txt"), lambda f: read_pose(f / "pose.txt", "ras")),
        "points": Target("points.txt", points, lambda f: read_points(f / "points.txt", "lps")),
        "landmarks": Target("pairs.csv", pairs, lambda f: read_landmarks(f / "pairs.csv", "ras")),
        "lesions": Target("lesions.txt", _template("lesions.txt"), lambda f: read_lesions(f / "lesions.txt")),
        "contours": Target(
            "contours.json",
            _template("contours.json"),
            lambda f: nodule_from_contours(f / "contours.json", _CONTOURED),
        ),
        "transform": Target("a.tfm", _transform, lambda f: read_transform(f / "a.tfm", GRID)),
        "markups": Target("p.mrk.json", _markups, lambda f: read_markups(f / "p.mrk.json")),
        "labels": Target("labels.json", labelled, lambda f: stored_names(f / "labels.nii.gz")),
        "plan": Target(
            "plan.json", lambda f: make_plan().save(f / "plan.json"), lambda f: Plan.load(f / "plan.json")
        ),
    }


def _results(folder: Path) -> None:
    from lungaccess.problem.system import load_system
    from lungaccess.running.study.results import ResultsFile
    from lungaccess.running.study.runs import Patient, Problem, Run
    from lungaccess.running.study.settings import PlannerChoice
    from tests.lungaccess.running.study.toys import toy_answer

    patient = Patient(anatomy="phantom", seed=1, size="small", spacing_mm=None, sources=(("a", "0" * 64),))
    problem = Problem(
        case="toy", patient=patient, system=load_system("ultrathin"), objective="inverse_clearance", target=1,
        target_lps=(1.0, 2.0, 3.0), origin="stated", start=0, rotations=4, stop_spacing_mm=8.0,
        site_spacing_mm=4.0, iterations=2, time_s=None,
    )  # fmt: skip
    with ResultsFile(folder / "results.db", create=True) as results:
        for seed in range(3):
            run = Run(problem=problem, planner=PlannerChoice(name="atlas"), seed=seed)
            results.add(run, toy_answer(run))
    shutil.copy(folder / "results.db", folder / "intact.db")


def _read_results(folder: Path) -> None:
    from lungaccess.running.study.results import ResultsFile
    from lungaccess.running.study.tables import QUERIES, differences, summarise, table

    for left in folder.glob("results.db-*"):
        left.unlink()
    summarise(folder / "results.db")
    differences(folder / "results.db", folder / "intact.db")
    with ResultsFile(folder / "results.db") as results:
        for name in QUERIES:
            list(table(results, name).rows)


def _record(folder: Path) -> None:
    from anatomy.segmentation.folder import SegmentationFolder

    made = SegmentationFolder(folder, GRID, "0" * 64)
    for name in ("airway", "lungs"):
        made.write(name, _voxels() > 1, key=name)
        made.note(name, {"voxels": 5})
    made.save()


def _read_record(folder: Path) -> None:
    from anatomy.segmentation.folder import SegmentationFolder

    made = SegmentationFolder(folder, GRID, "0" * 64)
    for name in ("airway", "lungs"):
        made.correction(name)
        made.facts(name)
        made.digest_if_made_from(name, name)


def _peer(folder: Path) -> None:
    run = {
        "patient": 1, "start": 2, "radius_mm": 50.0, "start_exemption_mm": 3.0, "planner": "rrt",
        "threads": 1, "valid_problem": True, "solved": True, "first_cpu_s": 0.5, "length_end_mm": 40.0,
        "goal_error_mm": None,
    }  # fmt: skip
    (folder / "peer.json").write_text(json.dumps({"runs": [run, run | {"solved": False}]}))


def _read_peer(folder: Path) -> None:
    from lungaccess.running.benchmark.published import read_peer

    read_peer(folder / "peer.json")


def targets() -> dict[str, Target]:
    """Return all targets by name."""
    return {
        "results": Target("results.db", _results, _read_results),
        "record": Target("segmentation.json", _record, _read_record),
        "peer": Target("peer.json", _peer, _read_peer),
        "nifti": _image_target("a.nii", lambda content: 352),
        "nifti-gzip": _image_target("a.nii.gz", None, compressed=True),
        "corrections": _corrections_target(),
        "nrrd": _image_target("a.nrrd", _after(b"\n\n")),
        "nrrd-gzip": _image_target("a.nrrd", _after(b"\n\n"), compressed=True),
        "metaimage": _image_target("a.mha", _after(b"LOCAL\n")),
        "metaimage-zlib": _image_target("a.mha", _after(b"LOCAL\n"), compressed=True),
        "metaimage-two-files": _image_target("a.mhd", len),
        "field-nrrd": _field_target("a.nrrd", _after(b"\n\n")),
        "field-metaimage": _field_target("a.mha", _after(b"LOCAL\n")),
        "field-nifti": _field_target("a.nii", lambda content: 352),
        "dicom": Target("slice.dcm", _series, _read_series, _before_pixels),
        **{
            f"centerlines-{name[0]}": Target(name, _centerlines, _read_centerlines(name))
            for name in ("a.vtp", "b.vtp", "c.vtu")
        },
        **_text_targets(),
    }


def damaged(rng: np.random.Generator, target: Target, intact: bytes) -> tuple[bytes, bool]:
    """Return damaged content, and whether the voxels in it are intact."""
    from tests.fuzz.mutations import mutated

    if target.header_bytes is not None and rng.random() < 0.8:
        return mutated(rng, intact, target.header_bytes(intact)), True
    if target.file.endswith(".gz") and rng.random() < 0.5:
        return gzip.compress(mutated(rng, gzip.decompress(intact), 352), 1), True
    return mutated(rng, intact), target.file.endswith(".gz")


def with_a_number(rng: np.random.Generator, target: Target, intact: bytes) -> tuple[bytes, bool]:
    """Return content one of whose numbers, wherever the file has one, is not finite, huge, tiny, or below 1.

    Numbers are the words of a text that read as such, and in what is no text any four or eight bytes.
    """
    from tests.fuzz.mutations import replaced_number

    is_packed = target.file.endswith(".gz")
    content = gzip.decompress(intact) if is_packed else intact
    first = target.header_bytes(content) if target.header_bytes else 352 if is_packed else len(content)
    new = replaced_number(rng, content[:first]) + content[first:]
    return gzip.compress(new, 1) if is_packed else new, False
