"""The safe start region: from which poses near a planned start the needle still reaches its target."""

import math
from typing import Any

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Float, Int, UInt8
from anatomy.base.words import percent
from anatomy.grid import read_only
from stages.needle.environment import NeedleEnvironment
from stages.needle.kernels import start_region as proof_kernel
from stages.needle.kernels import start_trial as kernel
from stages.needle.path import CURVATURE, ArcPath, Query, arc_transform, direct_path

KINDS = {
    kernel.DIRECT: "one arc",
    kernel.VIA: "two or three arcs",
    kernel.SEARCHED: "a search",
    kernel.NO_PATH: "no path found",
    kernel.START_BLOCKED: "start too near to an obstacle",
    kernel.OUT_OF_REACH: "target out of reach",
}
"""The kinds of a pose that was tried, in words."""
REACHING = (kernel.DIRECT, kernel.VIA, kernel.SEARCHED)

LEAST_MM, LEAST_DEG = 0.1, 0.1
"""Less is nothing that a hand could keep to, and is not told."""


@frozen_record
class ProvedStarts:
    """Start poses that all have a clear path, by proof.

    For every `n`: each pose at most `offsets_mm[n]` from the planned start whose direction is at most
    `tilts_rad[n]` from the planned one.  The path goes by single arcs through `vias[n]` to the target.

    Args:
        offsets_mm, tilts_rad ((K,) float64): Rising and falling; empty where nothing is proved.
        vias: tuple of (V, 3) float64, LPS mm.
    """

    offsets_mm: Float
    tilts_rad: Float
    vias: tuple[Float, ...]

    @property
    def best(self) -> int:
        """The pair whose poses, as ball times cone, have the greatest volume; -1 for none."""
        if not len(self.offsets_mm):
            return -1
        return int(np.argmax(self.offsets_mm**3 * (1.0 - np.cos(self.tilts_rad))))

    @property
    def offset_mm(self) -> float:
        """Offset of the best pair; 0 where nothing is proved."""
        return float(self.offsets_mm[self.best]) if self.best >= 0 else 0.0

    @property
    def tilt_rad(self) -> float:
        """Tilt of the best pair; 0 where nothing is proved."""
        return float(self.tilts_rad[self.best]) if self.best >= 0 else 0.0

    @property
    def volume(self) -> float:
        """Volume of the best pair's poses, mm^3 times steradian."""
        return 4.0 / 3.0 * math.pi * self.offset_mm**3 * 2.0 * math.pi * (1.0 - math.cos(self.tilt_rad))


@frozen_record
class TriedStarts:
    """Start poses that were tried one by one: places on a lattice in a ball, each with directions in a cone.

    Every pose stands for the same volume of places and the same solid angle.

    Args:
        offset_mm, tilt_rad: Radius of the ball and half angle of the cone.
        positions: (P, 3) float64, LPS mm.
        tangents ((P, D, 3) float64): Unit vectors.
        offsets_mm ((P,) float64, tilts_rad : (P, D) float64): From the planned start and direction.
        kinds ((P, D) uint8): What was found, see `KINDS`; every path is proved clear.
        spacing_mm: Of the lattice, whose axes are those of the start.
        lattice ((P, 3) int64): Places on it.
    """

    offset_mm: float
    tilt_rad: float
    positions: Float
    tangents: Float
    offsets_mm: Float
    tilts_rad: Float
    kinds: UInt8
    spacing_mm: float
    lattice: Int

    def share(self, offset_mm: float | None = None, tilt_rad: float | None = None) -> float:
        """Return the share of poses with a path, of those up to an offset and a tilt; of all by default."""
        near = self.offsets_mm <= (self.offset_mm if offset_mm is None else offset_mm)
        straight = self.tilts_rad <= (self.tilt_rad if tilt_rad is None else tilt_rad)
        part = np.isin(self.kinds[near[:, None] & straight], REACHING)
        return float(part.mean()) if part.size else math.nan

    @property
    def share_of_free(self) -> float:
        """Share of poses with a path among those that are not too near to an obstacle themselves."""
        free = self.kinds != kernel.START_BLOCKED
        return float(np.isin(self.kinds[free], REACHING).mean()) if free.any() else math.nan

    @property
    def share_by_place(self) -> Float:
        """Share of directions with a path at each place, `(P,)`."""
        return np.asarray(np.isin(self.kinds, REACHING).mean(axis=1))

    @property
    def counts(self) -> dict[str, int]:
        """Number of poses by what was found, see `KINDS`."""
        return {words: int(np.count_nonzero(self.kinds == kind)) for kind, words in KINDS.items()}

    def table(self, rings: int = 5) -> Float:
        """Return shares `(rings, rings)`: rows by offset, columns by tilt, in even steps; NaN for no pose."""
        far = np.minimum((self.offsets_mm / self.offset_mm * rings).astype(int), rings - 1)
        wide = np.minimum((self.tilts_rad / self.tilt_rad * rings).astype(int), rings - 1)
        ring = (far[:, None] * rings + wide).ravel()
        poses = np.bincount(ring, minlength=rings * rings)
        found = np.bincount(ring, np.isin(self.kinds, REACHING).ravel(), minlength=rings * rings)
        shares = np.full(rings * rings, math.nan)
        np.divide(found, poses, out=shares, where=poses > 0)
        return shares.reshape(rings, rings)


@frozen_record
class StartRegion:
    """From which poses near a planned start the needle reaches `radius_mm` of its target, clear."""

    lps_from_start: Float
    target: Float
    radius_mm: float
    max_curvature_per_mm: float
    proved: ProvedStarts
    tried: TriedStarts

    def path_from(self, lps_from_start: Float) -> ArcPath | None:
        """Return the proved path from a start pose, None if the pose is in no proved part.

        The path goes by single arcs through the via points to the target; where the last would have to bend
        more than the needle can, it bends as much as that can, and ends within the radius.
        """
        query = Query(lps_from_start=lps_from_start, target=self.target)
        frame, planned = query.lps_from_start, self.lps_from_start
        offset = float(np.linalg.norm(frame[:3, 3] - planned[:3, 3]))
        across = float(np.linalg.norm(np.cross(frame[:3, 2], planned[:3, 2])))
        tilt = math.atan2(across, float(frame[:3, 2] @ planned[:3, 2]))
        holding = (offset <= self.proved.offsets_mm) & (tilt <= self.proved.tilts_rad)
        if not holding.any():
            return None
        arcs = []
        for point in (*self.proved.vias[int(np.argmax(holding))], self.target):
            arcs.append(np.array(direct_path(frame, point).arcs[0]))
            frame = frame @ arc_transform(*arcs[-1])
        arcs[-1][CURVATURE] = min(arcs[-1][CURVATURE], self.max_curvature_per_mm)
        return ArcPath(lps_from_start=query.lps_from_start, arcs=np.array(arcs))

    @property
    def words(self) -> str:
        """The region in one sentence."""
        proved, tried = self.proved, self.tried
        first = "No start off the plan by 0.1 mm and 0.1° is proved"
        if proved.offset_mm >= LEAST_MM or math.degrees(proved.tilt_rad) >= LEAST_DEG:
            first = (
                f"The needle may start up to {_down(proved.offset_mm)} mm and "
                f"{_down(math.degrees(proved.tilt_rad))}° from the plan, proved"
            )
        return (
            f"{first}; {percent(tried.share())} of the poses up to {tried.offset_mm:g} mm and "
            f"{math.degrees(tried.tilt_rad):g}° still have a clear path {self.aim}"
        )

    @property
    def aim(self) -> str:
        """Where the paths end, in words."""
        return f"to within {self.radius_mm:.1f} mm of the target" if self.radius_mm else "to the target"

    def record(self) -> dict[str, Any]:
        """Return plain JSON values: poses in LPS mm, angles in degrees."""
        proved, tried = self.proved, self.tried
        table = [[None if math.isnan(v) else v for v in row] for row in tried.table().tolist()]
        return {
            "words": self.words,
            "lps_from_start": self.lps_from_start.tolist(),
            "target_lps": self.target.tolist(),
            "radius_mm": self.radius_mm,
            "proved": {
                "offset_mm": proved.offset_mm,
                "tilt_deg": math.degrees(proved.tilt_rad),
                "volume_mm3_sr": proved.volume,
                "offsets_mm": proved.offsets_mm.tolist(),
                "tilts_deg": np.degrees(proved.tilts_rad).tolist(),
            },
            "tried": {
                "offset_mm": tried.offset_mm,
                "tilt_deg": math.degrees(tried.tilt_rad),
                "poses": int(tried.kinds.size),
                "share": tried.share(),
                "counts": tried.counts,
                "share_by_offset_and_tilt": table,
            },
        }


def _down(value: float) -> str:
    """Return a number with one digit, never more than it is."""
    return f"{math.floor(10.0 * value) / 10.0:.1f}"


def prove_starts(environment: NeedleEnvironment, query: Query, path: ArcPath) -> ProvedStarts:
    """Prove for a ball of places times a cone of directions that every start in it has a clear path.

    The paths end within the environment's goal tolerance, and may go through the corners of the planned one.
    docs/explanation/start_region.md has the theorem.
    """
    families = [_Family(environment, query, vias) for vias in _vias_of(path)]
    most = proof_kernel.SEARCHED_MM * max(each.factor(proof_kernel.SEARCHED_MM, 0.0) for each in families)
    if not any(each.count for each in families):
        return ProvedStarts(offsets_mm=np.zeros(0), tilts_rad=np.zeros(0), vias=())
    # Offsets for which the largest proved tilt is computed: steps of 4 % of the largest.
    offsets = np.linspace(0.0, most, 25) if most > 0.0 else np.zeros(1)
    tilts = np.stack([each.largest_tilts(offsets) for each in families])
    chosen = np.argmax(tilts, axis=0)
    kept = np.flatnonzero(tilts.max(axis=0) >= 0.0)
    return ProvedStarts(
        offsets_mm=read_only(offsets[kept]),
        tilts_rad=read_only(tilts.max(axis=0)[kept]),
        vias=tuple(families[n].points[:-1] for n in chosen[kept]),
    )


def proved_factor(
    environment: NeedleEnvironment, query: Query, path: ArcPath, *, offset_mm: float, tilt_rad: float
) -> float:
    """Return the largest share of a deviation, at most 1, up to which all start poses are proved.

    The whole deviation, above 0, is such as three times the errors that are expected.  For many paths this is
    a fast measure of how much they bear: it takes a fraction of `prove_starts`.
    """
    families = (_Family(environment, query, vias) for vias in _vias_of(path))
    return max(each.factor(offset_mm, tilt_rad) for each in families)


class _Family:
    """The paths by single arcs through the same points, one from each start pose."""

    def __init__(self, environment: NeedleEnvironment, query: Query, vias: Float) -> None:
        frame = query.lps_from_start
        self.points = np.ascontiguousarray(np.vstack([vias, query.target]))
        arcs = np.zeros((len(self.points), proof_kernel.ARC_COLUMNS))
        stations = np.zeros((proof_kernel.MOST_STATIONS, proof_kernel.STATION_COLUMNS))
        self.count, angle = proof_kernel.lay_stations(
            environment.obstacles, environment.limits, query.branch,
            np.concatenate([frame[:3, 3], frame[:3, 2]]), self.points, arcs, stations,
        )  # fmt: skip
        self._laid = environment.limits, query.branch, arcs, stations, self.count, angle

    def factor(self, offset_mm: float, tilt_rad: float) -> float:
        """Return the largest factor, at most 1, by which offset and tilt are proved together."""
        if not self.count:
            return 0.0
        return float(proof_kernel.largest_factor(*self._laid, offset_mm, tilt_rad))

    def largest_tilts(self, offsets: Float) -> Float:
        """Return the largest proved tilt in rad at each offset, -1 where there is none."""
        tilts = np.full(len(offsets), -1.0)
        if self.count:
            proof_kernel.largest_tilts(*self._laid, offsets, tilts)
        return tilts


def _vias_of(path: ArcPath) -> list[Float]:
    """Return the sets of via points `(V, 3)` that the proved paths may go through."""
    # Ends of arcs of the plan that the proved family may go through: plans have one to three arcs.
    corners = path.frames()[1:-1, :3, 3][-4:]
    return [corners[first:] for first in range(len(corners) + 1)]
