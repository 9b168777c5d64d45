"""The patient as the devices see it: one immutable `Lung`."""

from functools import cached_property

import numpy as np

from anatomy.airway_tree import AirwayTree
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float, Int
from anatomy.fields import DistanceField
from anatomy.grid import Volume
from anatomy.lobes import LEAST_CHANCE, LOBES, UNKNOWN
from anatomy.morphology import components, voxels_in
from anatomy.motion.motion import Motion
from anatomy.organ import Organ
from anatomy.plausibility import FITS
from anatomy.structures import AIRWAY, OUTSIDE
from anatomy.tree.naming import SEGMENT_LOBES

HEIGHT_STEP = 4
"""Every fourth voxel is looked at to find apex and base: within 2 mm or so of 250 mm."""
NEAREST_LOBE_MM = 10.0
"""A place in no lobe, such as a bronchus or vessel, is named after a lobe that is as near as this."""


@frozen_record
class Lung(Organ):
    """The lungs of one patient with their airways, in LPS mm, immutable.

    Args:
        lumen_depth: Distance from a point in the lumen to the nearest voxel that is not lumen; 0 outside.
        lobes: uint8 numbers of `anatomy.lobes.LOBES` on `grid`, if the patient came with lobes.
        fissure_band: uint8 values of `anatomy.lobes.UNKNOWN` on `grid`, if the patient came with them.
        motion: How it breathes, if that is known.
    """

    lumen_depth: DistanceField
    tree: AirwayTree
    lobes: Volume | None = None
    fissure_band: Volume | None = None
    motion: Motion | None = None

    def _repr_html_(self) -> str:
        """Return the lung as HTML: what it is, its tree, and the warnings that came with it."""
        from anatomy.display import bullets, side_by_side, table

        rows = [
            ("kind", self.kind),
            ("grid", self.grid.describe()),
            ("breath hold", self.breath_hold or "not stated"),
            ("fissures", "given" if self.has_fissures else "not given"),
            ("nodule mask", "not given" if self.nodules is None else "given"),
            ("cost map", "not given" if self.cost is None else "given"),
            ("breathing", "not known" if self.motion is None else self.motion.source),
            ("start poses, targets", f"{len(self.starts)}, {len(self.targets_lps)}"),
            *self.tree.figures(),
            ("content", self.key[:16]),
        ]
        facts = table(rows, f"Lung of {self.name}") + bullets("Warnings", self.warnings)
        return side_by_side(facts, self.tree.drawing())

    @property
    def mask_words(self) -> str:
        """What a proof rests on: the airway of the masks, what was left out, and what is in doubt."""
        report = self.tree.report
        left_out = ""
        if report.components_dropped:
            left_out = f", without {report.components_dropped} pieces ({report.voxels_dropped} voxels) that "
            left_out += "hang on nothing"
        doubts = dict.fromkeys(each.name for each in self.findings if each.verdict != FITS)
        look = f"; their checks of {', '.join(doubts)} are not as usual" if doubts else ""
        return f"the masks of {self.name}, with an airway of {self.tree.n_branches} branches{left_out}{look}"

    @cached_property
    def nodule_parts(self) -> tuple[Int, Int]:
        """The voxels `(V, 3)` of all nodules of the mask, and of which part each is; see `components`."""
        if self.nodules is None:
            return np.zeros((0, 3), dtype=np.int64), np.zeros(0, dtype=np.int64)
        return components(self.nodules.array)

    @cached_property
    def _apex_and_base(self) -> tuple[tuple[float, float], ...]:
        """The height z in mm of apex and base of the right and of the left lung."""
        step = self.labels[::HEIGHT_STEP, ::HEIGHT_STEP, ::HEIGHT_STEP]
        points = self.grid.lps(HEIGHT_STEP * np.argwhere((step & (OUTSIDE | AIRWAY)) == 0))
        left = points[:, 0] > self.tree.carina_lps[0]
        sides = (each if len(each) else points for each in (points[~left], points[left]))
        return tuple((float(each[:, 2].max()), float(each[:, 2].min())) for each in sides)

    def height_share(self, point_lps: Float) -> float:
        """Return how far a point `(3,)` LPS mm is from the apex, 0, to the base, 1, of its lung.

        Left and right are those of the carina; a point beyond apex or base counts as there.
        """
        apex, base = self._apex_and_base[int(point_lps[0] > self.tree.carina_lps[0])]
        return float(np.clip((apex - point_lps[2]) / max(apex - base, 1e-9), 0.0, 1.0))

    def fissure_chance(self, points_lps: Float) -> float | None:
        """Return the chance that a path through points `(N, 3)` LPS mm, in order, crosses a fissure.

        How far the fissure lies from its border is one number for all of a band that the path is in, so that
        the chance is that of its places that differ most; of several visits to bands it is at most their sum.
        The 2.5 % beyond each side of a band count as none.

        Returns:
            None where the path goes through lung of which no band is known.
        """
        if self.fissure_band is None or self.lobes is None:
            return None
        value = self.fissure_band.at(points_lps, 0).astype(np.int64)
        lobe = self.lobes.at(points_lps, 0)
        if (value == UNKNOWN).any():
            return None
        beyond, total = np.where((value > 0) & (value < LEAST_CHANCE), 50, value) / 100.0, 0.0
        edges = np.flatnonzero(np.diff(value > 0, prepend=False, append=False))
        for first, last in zip(edges[::2], edges[1::2], strict=True):
            part = slice(max(first - 1, 0), last + 1)
            own = next((each for each in lobe[part] if each), 0)
            visited = np.where((lobe[part] == own) | (lobe[part] == 0), beyond[part], 1.0 - beyond[part])
            total += float(np.ptp(visited))
        return min(total, 1.0)

    def lobe_at(self, point_lps: Float) -> str:
        """Return the name of the lobe that holds a point `(3,)` LPS mm or is near it; "" if not known."""
        if self.lobes is None:
            return ""
        window = self.grid.window(point_lps, NEAREST_LOBE_MM)
        voxels = voxels_in(window, self.lobes.array[window] > 0)
        if not len(voxels):
            return ""
        distance = np.linalg.norm(self.grid.lps(voxels) - point_lps, axis=1)
        nearest = int(np.argmin(distance))
        number = int(self.lobes.array[tuple(voxels[nearest])])
        return LOBES[number] if distance[nearest] <= NEAREST_LOBE_MM else ""

    def segment_at(self, point_lps: Float) -> str:
        """Return the segment that holds a point `(3,)` LPS mm, such as "RS6"; "" if that is not sure.

        It is that of the nearest bronchus, unless that is unnamed, a bronchus of another segment is nearly as
        near, or the point lies in another lobe.
        """
        tree, near = self.tree, np.linalg.norm(self.tree.points_lps - point_lps, axis=1)
        first = int(np.argmin(near))
        segments = np.array(tree.bronchi.segments)[tree.branch_of_point]
        other = near[segments != segments[first]].min(initial=np.inf)
        lobe, its = self.lobe_at(point_lps), LOBES.get(int(tree.bronchi.lobes[tree.branch_of_point[first]]))
        # A place is in a segment if its bronchi are nearer by this than any other: 9 of 10 are then right.
        sure = other - near[first] >= 6.0 and (not lobe or lobe == its)
        return str(segments[first]) if sure else ""

    def region_at(self, point_lps: Float) -> str:
        """Return segment and lobe at a point `(3,)` LPS mm, as far as known: "RS6, right lower lobe"."""
        segment, lobe = self.segment_at(point_lps), self.lobe_at(point_lps)
        if segment and not lobe:
            lobe = LOBES[SEGMENT_LOBES[segment[0]][int(segment[2:].partition("+")[0])]]
        return ", ".join(each for each in (segment, lobe) if each)

    def branch_words(self, branch: int) -> str:
        """Return the number of an airway branch, with its name, else the lobe in which it ends, if known."""
        lobe = self.lobe_at(self.tree.points_lps[self.tree.branch_points(branch)[-1]])
        name = self.tree.bronchi.words(branch) or lobe
        return f"{branch} ({name})" if name else f"{branch}"
