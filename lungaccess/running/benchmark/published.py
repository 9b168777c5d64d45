"""The needle queries that were published with patients: every start pose with every target.

The rules of the UNC steerable-needle-planner: voxel centres, a ball around the start, no fissures.

Obstacles are the masks as they are: airway, vessels and everything outside the lungs.  A point is free if
every obstacle voxel's centre is at least the needle's radius and half a voxel diagonal away; voxels in a ball
around the start do not count.  A path ends within a tolerance of the target, at any angle.
"""

import json
import math
import re
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from anatomy.base.errors import FileError
from anatomy.base.files import DAMAGE, reason
from anatomy.base.records import frozen_record, frozen_value
from anatomy.base.typed import Float, Labels
from anatomy.fields import CENTRES
from anatomy.grid import Grid
from anatomy.liver import LiverImages
from anatomy.morphology import voxels_in
from anatomy.organ import Organ
from anatomy.patient import PatientImages
from anatomy.structures import AIRWAY, OBSTACLES, OUTSIDE, VESSEL
from stages.needle import Needle, NeedleEnvironment, environment_of_labels

Key = tuple[int, int, float]
"""Number of the patient, number of the start, and radius of curvature in mm."""

UNC_NEEDLE_DIAMETER_MM = 2.0
UNC_GOAL_TOLERANCE_MM = 1.0
UNC_MAX_LENGTH_MM = 150.0
UNC_MAX_TURN_DEG = 90.0
UNC_EXEMPT_MM = 3.0
"""Numbers of the recorded runs: diameter, tolerance, insertion, total turn, and the radius of the ball."""

NO_STARTS = "no query: the patient came without start poses"


@frozen_record
class PublishedQuery:
    """One start pose `(4, 4)` and one target of a patient, LPS mm, both counted from 1."""

    patient: str
    start: int
    target: int
    lps_from_start: Float
    target_lps: Float


def published_queries(patient: PatientImages | LiverImages | Organ, name: str) -> list[PublishedQuery]:
    """Return each start of a patient with each of its targets, or with that which its name states.

    A start called `target2_start1` or `nodule2_start1` belongs to `target2` alone.
    """
    return [
        PublishedQuery(patient=name, start=s, target=t, lps_from_start=pose, target_lps=point)
        for s, pose in enumerate(patient.starts, start=1)
        for t, point in enumerate(patient.targets_lps, start=1)
        if _belong_together(patient.start_names[s - 1 : s], patient.target_names[t - 1 : t])
    ]


def _belong_together(start: Sequence[str], target: Sequence[str]) -> bool:
    stated = re.match(r"(?:target|nodule)(\d+)_", "".join(start).lower())
    known = re.fullmatch(r"targets?_?(\d+)", "".join(target).lower())
    return stated is None or known is None or stated[1] == known[1]


def why_no_query(patient: PatientImages | LiverImages | Organ) -> str:
    """Return why a patient has no query; "" if it has one."""
    if not patient.starts:
        return NO_STARTS
    return "" if patient.targets_lps else "no query: the patient came without targets"


def patients_of(folder: Path) -> list[Path]:
    """Return the patients of a folder by their numbers, or itself if it is one; FileError without any."""
    from anatomy.io.images import image_suffix

    if not folder.is_dir():
        raise FileError(
            f"There is no folder {folder}",
            expected="a folder of a patient, or a folder of such folders",
            remedy="Check the name and the folder",
        )
    entries = sorted(folder.iterdir(), key=_natural)
    if any(path.is_file() and (image_suffix(path) or path.suffix == ".toml") for path in entries):
        return [folder]
    inner = [path for path in entries if path.is_dir()]
    if not inner:
        raise FileError(
            f"{folder} holds neither images nor folders",
            expected="a patient, or a folder of patients",
            remedy="Name the folder that holds the masks, or the one that holds the patients",
        )
    return inner


def _natural(path: Path) -> tuple[str, int, str]:
    digits = re.search(r"\d+", path.name)
    return (path.name[: digits.start()] if digits else path.name, int(digits[0]) if digits else 0, path.name)


def unc_needle(radius_mm: float, *, max_accumulated_turn_deg: float = UNC_MAX_TURN_DEG) -> Needle:
    """Return the peer's needle, which bends with a radius of at least `radius_mm`."""
    return Needle(
        diameter_mm=UNC_NEEDLE_DIAMETER_MM,
        max_curvature_per_mm=1.0 / radius_mm,
        max_length_mm=UNC_MAX_LENGTH_MM,
        max_angle_from_start_deg=UNC_MAX_TURN_DEG,
        max_accumulated_turn_deg=max_accumulated_turn_deg,
    )


@frozen_record
class UncObstacles:
    """The label volume of one patient, and the distance that a needle's axis keeps from voxel centres."""

    labels: Labels
    grid: Grid

    @property
    def required_mm(self) -> float:
        """Radius and half a voxel diagonal."""
        return 0.5 * UNC_NEEDLE_DIAMETER_MM + 0.5 * float(np.linalg.norm(self.grid.spacing_mm))

    def environment(
        self, needle: Needle, lps_from_start: Float, target_lps: Float, *, exempt_mm: float = UNC_EXEMPT_MM
    ) -> NeedleEnvironment:
        """Return the labels in a box about start and target, less the exempt ball, as an environment.

        Obstacle voxels whose centres lie within `exempt_mm` of the start do not count.
        """
        ends = np.stack([lps_from_start[:3, 3], target_lps])
        # Obstacles are cut out so far around a query; a path that leaves this box is too long.
        border = 30.0 + 0.2 * float(np.linalg.norm(ends[1] - ends[0]))
        corners = np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T
        ijk = self.grid.ijk((ends[:, None] + border * corners).reshape(-1, 3))
        low = np.maximum(np.floor(ijk.min(axis=0)).astype(int), 0)
        high = np.minimum(np.ceil(ijk.max(axis=0)).astype(int) + 1, self.grid.shape)
        labels = self.labels[tuple(slice(a, b) for a, b in zip(low, high, strict=True))].copy(order="F")
        grid = self.grid.crop(low, high)
        if exempt_mm > 0.0:
            window = grid.window(ends[0], exempt_mm)
            voxels = voxels_in(window, (labels[window] & OBSTACLES) != 0)
            near = np.linalg.norm(grid.lps(voxels) - ends[0], axis=1) <= exempt_mm
            labels[tuple(voxels[near].T)] = 0
        return environment_of_labels(
            labels,
            grid,
            needle,
            required_clearance_mm=self.required_mm,
            obstacles_as=CENTRES,
            goal_tolerance_mm=UNC_GOAL_TOLERANCE_MM,
        )


def unc_obstacles(images: PatientImages | LiverImages) -> UncObstacles:
    """Label the masks of a patient as they are; of a liver, its vessels and what is not liver or nodule."""
    labels = np.zeros(images.grid.shape, dtype=np.uint16, order="F")
    if isinstance(images, LiverImages):
        labels[images.vessels] |= VESSEL
        labels[~images.inside] |= OUTSIDE
        return UncObstacles(labels=labels, grid=images.grid)
    labels[images.lumen.array] |= AIRWAY
    labels[images.vessels.array] |= VESSEL
    labels[~images.lung.array] |= OUTSIDE
    return UncObstacles(labels=labels, grid=images.grid)


@frozen_value
class PeerResult:
    """What was recorded for one query: the kind of run that solved it most often, and then soonest.

    Time and length are medians of its solved runs: processor time to the first path, and the length of the
    last one with the distance that it leaves to the target.  Where the peer refused the query, no run was
    made.
    """

    planner: str
    runs: int
    solved: int
    first_cpu_ms: float | None
    length_mm: float | None
    refused: bool


def read_peer(path: Path) -> Mapping[Key, PeerResult]:
    """Read recorded runs of one thread that ignore obstacles 3 mm about the start; FileError without any."""
    try:
        runs = json.loads(path.read_text(encoding="utf-8"))["runs"]
        found: dict[Key, dict[str, list[dict[str, Any]]]] = defaultdict(lambda: defaultdict(list))
        for run in runs:
            if run["threads"] == 1 and run["start_exemption_mm"] == UNC_EXEMPT_MM:
                key = (int(run["patient"]), int(run["start"]), float(run["radius_mm"]))
                found[key][str(run["planner"])].append(run)
        return {key: _best(kinds) for key, kinds in found.items()}
    except DAMAGE as error:
        raise FileError(
            f"{path} holds no recorded results ({type(error).__name__}: {reason(error)})",
            expected='a JSON file {"runs": [...]} with patient, start, radius_mm, start_exemption_mm,'
            " planner, threads, valid_problem, solved, first_cpu_s, length_end_mm of every run",
            remedy="Leave out --peer to run without them",
        ) from error


def _best(kinds: Mapping[str, list[dict[str, Any]]]) -> PeerResult:
    def of(name: str) -> PeerResult:
        runs = [run for run in kinds[name] if run["valid_problem"]]
        solved = [run for run in runs if run["solved"]]
        firsts = [1e3 * run["first_cpu_s"] for run in solved if run["first_cpu_s"] is not None]
        return PeerResult(
            planner=name,
            runs=len(runs),
            solved=len(solved),
            first_cpu_ms=known_median(firsts),
            length_mm=known_median(r["length_end_mm"] + (r["goal_error_mm"] or 0.0) for r in solved),
            refused=not runs,
        )

    results = [of(name) for name in kinds]
    return max(results, key=lambda r: (r.solved / max(r.runs, 1), -(r.first_cpu_ms or math.inf)))


def known_median(values: Iterable[float | None]) -> float | None:
    """Return the median of the values that are known; None without one."""
    known = [each for each in values if each is not None]
    return median(known) if known else None


def patient_number(name: str) -> int:
    """Return the number in the name of a patient's folder; 0 if there is none."""
    digits = re.search(r"\d+", name)
    return int(digits[0]) if digits else 0
