"""The reachability map: for a grid of points in the lung, whether and how well a system reaches them."""

import hashlib
import os
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.errors import SettingsError
from anatomy.base.files import require_writable_folder
from anatomy.base.records import frozen_record, frozen_value
from anatomy.base.typed import Bool, Int, UInt8
from anatomy.grid import Grid, Volume
from anatomy.io.images import write_volume
from anatomy.lung import Lung
from anatomy.machine_code.sources import kernel_digest
from lungaccess.planning.coupled import reach_scan
from lungaccess.planning.coupled.atlas import Atlas, build_atlas, require_same
from lungaccess.planning.reachability.layers import (
    LayerStore,
    Regions,
    counted_voxels,
    lung_regions,
    scan_layers,
    voxel_seeds,
)
from lungaccess.problem.request import require_phases
from lungaccess.problem.system import System, system_fingerprint
from lungaccess.uncertainty.breathing.window import require_motion
from stages.needle import (
    DEFAULT_ARCS,
    DIRECT,
    NO_CLEARANCE,
    SEARCHED,
    UNREACHED,
    direct_arcs,
    needle_environment,
)

DEFAULT_SPACING_MM = 3.0
"""Half the diameter of a small nodule, so that none falls between the points."""
FORMAT = b"lungaccess-reach-3"

NOT_COUNTED = 0
KINDS: dict[str, int] = {
    "direct arc": DIRECT,
    "search": SEARCHED,
    "undecided": UNREACHED,
    "unreachable": NO_CLEARANCE,
}
"""What the voxels of a map say; `NOT_COUNTED` is outside the lung or in an obstacle."""
STATES: dict[str, tuple[str, ...]] = {
    "reachable": ("direct arc", "search"),
    "unreachable": ("unreachable",),
    "undecided": ("undecided",),
}
"""Reachable: there is a plan.  Unreachable: it is proved that there is none.  Undecided: neither."""


@frozen_value
class RegionReach:
    """How much of a region, in mL of lung tissue that is no obstacle, a system reaches.

    The shares are by the order of `KINDS`, all 0 if there is no such tissue; medians are of what is reached,
    nan if nothing is.
    """

    name: str
    volume_ml: float
    shares: tuple[float, ...]
    median_cost: float
    median_clearance_mm: float

    @property
    def reached(self) -> float:
        """Share reached by an arc or a search."""
        return self.share("reachable")

    def state_ml(self, state: str) -> float:
        """Return the volume of one of `STATES`, mL."""
        return self.volume_ml * self.share(state)

    def share(self, state: str) -> float:
        """Return the share of one of `STATES`."""
        return sum(share for name, share in zip(KINDS, self.shares, strict=True) if name in STATES[state])


@frozen_record
class ReachMap:
    """What a system reaches in a lung; all volumes are on one grid.

    Args:
        kinds (Volume of uint8): `NOT_COUNTED` or one of `KINDS` at each voxel, classified by its centre.
        cost, clearance_mm (Volume of float32): Estimated integral of 1 / clearance of the best path found,
            and the clearance that it keeps beyond the exempt length of the needle; 0 where there is none.
        deployment (Volume of int32): Number of the deployment of the atlas from which that path starts, or
            -1.
        resumed_layers: Layers of voxels that an earlier run had finished.
        phases (tuple of 2 floats or None): Phases of the breath in all of which voxels count as reached; None
            for the masks' alone.
        window_share (Volume of float32 or None): With phases, the share of the breath in which the path found
            is proved; 0 where there is none.
    """

    patient_name: str
    system: System
    with_fissures: bool
    kinds: Volume
    cost: Volume
    clearance_mm: Volume
    deployment: Volume
    regions: Regions
    entries: int
    trees: int
    resumed_layers: int
    scan_s: float
    atlas_s: float
    phases: tuple[float, float] | None = None
    window_share: Volume | None = None

    @property
    def words(self) -> str:
        """What is mapped, in words."""
        what = f"What {self.system.name} reaches of {self.patient_name}"
        if self.phases is None:
            return what
        first, last = (100.0 * phase for phase in self.phases)
        return f"{what} from {first:g} % to {last:g} % of the breath"

    def by_region(self) -> tuple[RegionReach, ...]:
        """Return what is reached of each lung, of each lobe if they are known, and of all of them last."""
        return *(self._reach(name, where) for name, where in self.regions.parts()), self.total

    def by_segment(self) -> tuple[RegionReach, ...]:
        """Return what is reached of each segment whose bronchus is named, see `anatomy.tree.naming`."""
        names, codes = self.regions.segment_names, self.regions.segments.array
        return tuple(self._reach(name, codes == code) for code, name in enumerate(names, start=1))

    @property
    def total(self) -> RegionReach:
        """What is reached of the whole lung."""
        return self._reach("total", self.kinds.array != NOT_COUNTED)

    @property
    def reached(self) -> Bool:
        """The voxels that are reached by an arc or a search."""
        return self.in_state("reachable")

    def in_state(self, state: str) -> Bool:
        """Return the voxels of one of `STATES`."""
        return np.isin(self.kinds.array, [KINDS[name] for name in STATES[state]])

    def gained_and_lost_ml(self, other: "ReachMap") -> tuple[float, float]:
        """Return the volume that this map reaches and another does not, and the reverse.

        GridMismatchError is raised if the maps are not on the same grid.
        """
        self.kinds.grid.require_same(other.kinds.grid, "the other map")
        ml = self.kinds.grid.voxel_volume_mm3 / 1000.0
        gained = np.count_nonzero(self.reached & ~other.reached)
        return gained * ml, np.count_nonzero(other.reached & ~self.reached) * ml

    def _reach(self, name: str, where: Bool) -> RegionReach:
        kinds = self.kinds.array[where]
        counts = np.array([np.count_nonzero(kinds == code) for code in KINDS.values()])
        reached = where & self.reached
        found = bool(reached.any())
        return RegionReach(
            name=name,
            volume_ml=float(counts.sum()) * self.kinds.grid.voxel_volume_mm3 / 1000.0,
            shares=tuple((counts / max(counts.sum(), 1)).tolist()),
            median_cost=float(np.median(self.cost.array[reached])) if found else float("nan"),
            median_clearance_mm=float(np.median(self.clearance_mm.array[reached])) if found else float("nan"),
        )

    def save(self, folder: str | os.PathLike[str], stem: str = "reach") -> tuple[Path, ...]:
        """Write the map as four images, five with phases, that 3D Slicer opens in the patient's frame.

        `STEM.nrrd` holds the kinds as labels, `STEM-cost.nrrd`, `STEM-clearance.nrrd` and
        `STEM-deployment.nrrd` the rest, `STEM-window.nrrd` the share of the breath.  FileError is raised if
        the folder cannot be written to.
        """
        place = require_writable_folder(Path(folder))
        volumes = {"": self.kinds, "-cost": self.cost, "-clearance": self.clearance_mm}
        volumes["-deployment"] = self.deployment
        volumes |= {} if self.window_share is None else {"-window": self.window_share}
        written = tuple(place / f"{stem}{end}.nrrd" for end in volumes)
        for path, volume in zip(written, volumes.values(), strict=True):
            write_volume(path, volume)
        return written


def reach_grid(lung: Lung, spacing_mm: float) -> Grid:
    """Return the grid of cubes along a lung's axes that covers it; SettingsError unless of 0.5 to 50 mm."""
    if not 0.5 <= spacing_mm <= 50.0:
        raise SettingsError(
            f"The spacing of the map is {spacing_mm} mm",
            expected="0.5 to 50 mm",
            remedy="Choose such a spacing, for instance --spacing 3",
        )
    axes = lung.grid.lps_from_ijk[:3, :3] / lung.grid.spacing_mm
    size = np.ceil(np.array(lung.grid.shape) * lung.grid.spacing_mm / spacing_mm - 1e-9).astype(int)
    matrix = np.eye(4)
    matrix[:3, :3] = axes * spacing_mm
    matrix[:3, 3] = lung.grid.lps(np.full(3, -0.5)) + 0.5 * spacing_mm * axes.sum(axis=1)
    return Grid(shape=(int(size[0]), int(size[1]), int(size[2])), lps_from_ijk=matrix)


def map_reach(
    lung: Lung,
    system: System,
    *,
    spacing_mm: float = DEFAULT_SPACING_MM,
    arcs: int = DEFAULT_ARCS,
    trees: int = 0,
    phases: tuple[float, float] | None = None,
    atlas: Atlas | None = None,
    work: str | os.PathLike[str] | None = None,
    progress: Callable[[float], None] | None = None,
) -> ReachMap:
    """Return what a system reaches of a lung.

    Every free point is tried from all deployments of the atlas: first single arcs and, with `trees`, also
    paths of several arcs.  Without a needle the tubes are aimed at it.  The same inputs give the same map,
    resumed or not.

    Args:
        arcs, trees: See `stages.needle.reach.ReachScan`.
        phases (tuple of 2 floats): Phases of the breath in all of which a voxel has to be reached, by single
            arcs; a voxel takes a hundred times as long, so that a spacing of 10 mm is apt.
        atlas: Made with `build_atlas` beforehand; made here if None.
        work: Folder where finished layers are kept until the map is complete, so that a later call with the
            same inputs goes on from there.

    Raises:
        SettingsError: If spacing, arcs or trees are out of range, trees are asked for without a needle, or
            the atlas belongs to another lung or system.
        FileError: If the folder cannot be written to.
    """
    grid = reach_grid(lung, spacing_mm)
    if atlas is not None and (atlas.lung.key != lung.key or atlas.system != system):
        raise SettingsError(
            f"The atlas was made for {atlas.lung.name} and {atlas.system.name}",
            expected=f"one for {lung.name} and {system.name}",
        )
    made = atlas or build_atlas(lung, system)
    began = time.perf_counter()
    if trees:
        system.require_needle("A search with random trees")
    asked = None if phases is None else require_phases(*phases)
    if asked is not None:
        require_motion(lung)
    scan = reach_scan(made, arcs=arcs, trees=trees, during=None if asked is None else (lung, asked))
    counted = counted_voxels(lung, grid, made.with_fissures)
    store = None if work is None else LayerStore(Path(work), _key(lung, made, spacing_mm, arcs, trees, asked))
    found, entries, resumed = scan_layers(scan, grid, counted, store, progress)
    return ReachMap(
        patient_name=lung.name,
        system=system,
        with_fissures=made.with_fissures,
        kinds=Volume(grid=grid, array=found[0].astype(np.uint8)),
        cost=Volume(grid=grid, array=found[1]),
        clearance_mm=Volume(grid=grid, array=found[2]),
        deployment=Volume(grid=grid, array=entries),
        regions=lung_regions(lung, grid, counted),
        entries=made.deployments.count,
        trees=trees,
        resumed_layers=resumed,
        scan_s=time.perf_counter() - began,
        atlas_s=made.build_s,
        phases=asked,
        window_share=None if asked is None else Volume(grid=grid, array=found[3]),
    )


def compare_reach(
    lung: Lung,
    systems: Iterable[System],
    *,
    progress: Callable[[str, float], None] | None = None,
    **settings: Any,
) -> tuple[ReachMap, ...]:
    """Return the maps of several systems, all on the same grid; settings are those of `map_reach`.

    Args:
        progress: Told the name of the system and the share of its layers done.
    """
    tell = progress or (lambda _name, _share: None)
    return tuple(map_reach(lung, each, progress=partial(tell, each.name), **settings) for each in systems)


def _key(
    lung: Lung, atlas: Atlas, spacing_mm: float, arcs: int, trees: int, phases: tuple[float, float] | None
) -> str:
    digest = hashlib.sha256(FORMAT + kernel_digest().encode())
    digest.update(f"{atlas.lung.key} {system_fingerprint(atlas.system)} {atlas.with_fissures}".encode())
    digest.update(f"{spacing_mm!r} {arcs} {trees}".encode())
    if phases is not None:
        digest.update(f"{phases!r} {require_motion(lung).key}".encode())
    entries = atlas.deployments
    for array in (entries.positions, entries.tangents, entries.branch):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:16]


FIRST_POINTS, MOST_POINTS = 32, 256
"""Points of the first part, and of any: a point takes a millisecond or several, and a viewer waits."""


@frozen_record
class ReachPart:
    """What became of N points of a grid, by the numbers of their voxels, C order: one of `KINDS` each.

    `entries` are deployments of the atlas whose arcs are proved clear, -1 for none; `share` is that of the
    counted voxels that is known with this part.
    """

    voxels: Int
    kinds: UInt8
    entries: Int
    share: float


class ReachStream:
    """Tells which points of a coarse grid a system reaches by single arcs, part by part.

    `counted` (M,) are numbers of the voxels whose centre lies in lung tissue that is no obstacle.
    SettingsError is raised if the atlas belongs to another lung or system.
    """

    def __init__(self, lung: Lung, system: System, atlas: Atlas) -> None:
        require_same(atlas, lung, system)
        # At 8 mm a whole lung takes seconds; a map of 3 mm is `map_reach`.
        self.grid: Grid = reach_grid(lung, 8.0)
        self.counted: Int = np.flatnonzero(counted_voxels(lung, self.grid, atlas.with_fissures))
        self._lung, self._system, self._atlas = lung, system, atlas

    def parts(self, around_lps: ArrayLike, known: Int | None = None) -> Iterator[ReachPart]:
        """Yield all counted voxels, those nearest to a point `(3,)` LPS mm first.

        What neighbouring points have in common is found once, so that parts become larger.  `known` (V,) are
        the deployments, -1 for none, from which another needle reached the voxels of the grid: where that arc
        is clear for this needle, too, the voxel is in the first part.
        """
        points = self.grid.lps(np.stack(np.unravel_index(self.counted, self.grid.shape), axis=1))
        order = np.argsort(np.linalg.norm(points - np.asarray(around_lps), axis=1), kind="stable")
        voxels, points = self.counted[order], points[order]
        done = 0
        if known is not None and self._system.needle is not None:
            again = self._again(points, known[voxels])
            done = int(np.count_nonzero(again))
            entries = known[voxels[again]]
            kinds = np.full(done, DIRECT, dtype=np.uint8)
            yield ReachPart(
                voxels=voxels[again], kinds=kinds, entries=entries, share=done / max(len(voxels), 1)
            )
            voxels, points = voxels[~again], points[~again]
        scan = reach_scan(replace(self._atlas, system=self._system), arcs=1)
        begin, count = 0, FIRST_POINTS
        while begin < len(voxels):
            part = slice(begin, begin + count)
            ijk = np.stack(np.unravel_index(voxels[part], self.grid.shape), axis=1)
            found = scan.reach(points[part], voxel_seeds(self.grid, ijk))
            begin += count
            share = min(1.0, (done + begin) / len(self.counted))
            yield ReachPart(voxels=voxels[part], kinds=found.kinds, entries=found.entries, share=share)
            count = min(2 * count, MOST_POINTS)

    def _again(self, points: ArrayLike, entries: Int) -> Bool:
        """Tell which points `(N, 3)` the arc from a deployment reaches with the needle of the system."""
        system, places, fissures = self._system, np.asarray(points), self._atlas.with_fissures
        needle = system.require_needle("A direct arc")
        environment = needle_environment(self._lung, needle, system.margins, with_fissures=fissures)
        deployments, reached = self._atlas.deployments, np.zeros(len(entries), dtype=bool)
        for row in np.flatnonzero(entries >= 0).tolist():
            at = entries[row : row + 1]
            start = deployments.positions[at], deployments.tangents[at], deployments.branch[at]
            reached[row] = direct_arcs(environment, *start, places[row])[0][0] == 0
        return reached
