"""The window of a plan by brute force: at many phases, distances to voxels as the motion deforms them.

It shares no arithmetic with the proof: displacements by scipy's interpolation, rotations by singular values,
distances to each deformed voxel, a parallelepiped, by projected descent.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from anatomy.base.typed import Bool, Float, Int
from anatomy.lung import Lung
from anatomy.motion.motion import Motion
from anatomy.structures import AIRWAY, BRANCH_SHIFT, FISSURE, OBSTACLES, OUTSIDE
from lungaccess.plans.plan import Plan
from lungaccess.uncertainty.breathing.window import TIP_BALL_MM, TIP_STEP_MM

POINT_MM = 0.1
"""Along the devices: between two points a clearance is at most 0.05 mm less, mostly far less."""
CANDIDATES = 24
"""Voxels near a point that are measured."""
LOOKED_MM = 3.0
"""Voxels farther from a point in the masks are far enough in every phase."""
WALL_ZONE_MM = 1.0
SWEEPS = 6


class BruteForce:
    """The clearance and the miss of a plan in one phase after the other."""

    def __init__(self, plan: Plan, lung: Lung, motion: Motion) -> None:
        self._plan, self._lung, self._motion = plan, lung, motion
        self._side = int(plan.target_lps[0] > motion.middle_x_mm)
        curves = plan.curves(POINT_MM)
        way_out, tubes = plan.tube.exit.arc_length_mm, curves.tubes
        extra = plan.system.margins.total_mm + plan.tube.clearance_loss_mm
        self._parts = [
            (tubes.points_lps[tubes.arc_length_mm > way_out],
             (tubes.radius_mm + extra)[tubes.arc_length_mm > way_out],
             np.ones((tubes.arc_length_mm > way_out).sum(), dtype=bool))
        ]  # fmt: skip
        if plan.needle is not None:
            needle = curves.needle
            exempt = needle.arc_length_mm < plan.exemption.needle_length_mm
            required = np.full(len(needle.points_lps), plan.required_clearance_mm["needle"])
            self._parts.append((needle.points_lps, required, exempt))
        self.points = np.concatenate([part[0] for part in self._parts])
        self.required = np.concatenate([part[1] for part in self._parts])
        self.exempt: Bool = np.concatenate([part[2] for part in self._parts])
        self._tip = np.asarray(plan.scope.lps_from_scope_tip[:3, 3])
        self._gradient = self._mean_gradient()
        self._voxels = self._near_voxels()

    def displacement(self, places: Float) -> Float:
        """Return d `(N, 3)` at places of the masks, by scipy."""
        index = self._motion.grid.ijk(places).T
        nodes = self._motion.nodes[self._side]
        return np.stack(
            [ndimage.map_coordinates(nodes[..., n], index, order=1, mode="nearest") for n in range(3)], axis=1
        )

    def _mean_gradient(self) -> Float:
        steps = np.arange(-TIP_BALL_MM, TIP_BALL_MM + 1e-9, TIP_STEP_MM)
        ball = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
        ball = ball[np.linalg.norm(ball, axis=1) <= TIP_BALL_MM]
        return np.linalg.lstsq(ball, self.displacement(self._tip + ball), rcond=None)[0].T

    def carried(self, points: Float, share: float) -> Float:
        """Return where the devices' points are."""
        left, _, right = np.linalg.svd(np.eye(3) + share * self._gradient)
        moved = self._tip + share * self.displacement(self._tip[None])[0]
        return (points - self._tip) @ (left @ right).T + moved

    def _near_voxels(self) -> tuple[Int, cKDTree]:
        """Return obstacle voxels near the devices in any phase, and a tree of their centres."""
        lung, bits = self._lung, OBSTACLES
        places = [self.pulled_back(self.carried(self.points, s), s) for s in self._shares(9)]
        window = lung.grid.window(np.concatenate(places), LOOKED_MM + 1.0)
        if self._plan.fissures_are_obstacles:
            bits |= FISSURE
        hits = (lung.labels[window] & bits) != 0
        inner = ndimage.binary_erosion(hits, border_value=1)
        voxels = np.argwhere(hits & ~inner) + [cut.start for cut in window]
        self._bits = bits
        return voxels, cKDTree(lung.grid.lps(voxels))

    def _shares(self, count: int) -> Float:
        return self._motion.amplitude * (np.linspace(0.0, 1.0, count) - self._motion.masks_phase)

    def pulled_back(self, points: Float, share: float) -> Float:
        """Return the places of the masks that are at points."""
        found = points
        for _ in range(40):
            found = points - share * self.displacement(found)
        return found

    def clearance(self, phase: float) -> Float:
        """Return the distance `(N,)` of each point to what it must be clear of, less what is required, mm."""
        share = self._motion.amplitude * (phase - self._motion.masks_phase)
        points = self.carried(self.points, share)
        at = self.pulled_back(points, share)
        voxels, tree = self._voxels
        labels = self._lung.labels[tuple(voxels.T)]
        own = self._own(labels)
        distance, index = tree.query(at, k=CANDIDATES, distance_upper_bound=LOOKED_MM)
        flat = np.flatnonzero(np.isfinite(distance).ravel())
        which, who = flat // CANDIDATES, index.ravel()[flat]
        keep = ~(own[who] & self.exempt[which])
        which, who = which[keep], who[keep]
        near, inverse = np.unique(who, return_inverse=True)
        centres = self._lung.grid.lps(voxels[near])
        moved = centres + share * self.displacement(centres)
        axes = self._lung.grid.lps_from_ijk[:3, :3]
        m = np.stack(
            [axes[:, n] + share * (self.displacement(centres + 0.5 * axes[:, n])
             - self.displacement(centres - 0.5 * axes[:, n])) for n in range(3)], axis=-1,
        )  # fmt: skip
        gap = _to_boxes(m[inverse], moved[inverse] - points[which])
        out = np.full(len(points), LOOKED_MM)
        np.minimum.at(out, which, gap)
        inside = self._inside(at)
        out[inside] = 0.0
        return out - self.required

    def _inside(self, at: Float) -> Bool:
        index = np.rint(self._lung.grid.ijk(at)).astype(int)
        within = ((index >= 0) & (index < np.asarray(self._lung.labels.shape))).all(axis=1)
        labels = np.full(len(at), OUTSIDE)
        labels[within] = self._lung.labels[tuple(index[within].T)]
        return ((labels & self._bits) != 0) & ~(self._own(labels) & self.exempt)

    def _own(self, labels: Int) -> Bool:
        """Tell which labels are nothing but airway of the pierced branch."""
        of_branch = (labels >> BRANCH_SHIFT) - 1 == self._plan.exemption.branch
        return ((labels & self._bits) == AIRWAY) & of_branch

    def miss_mm(self, phase: float) -> float:
        """Return how far the end of the devices is from the moved target."""
        share = self._motion.amplitude * (phase - self._motion.masks_phase)
        target = np.asarray(self._plan.target_lps)[None]
        moved = target + share * self.displacement(target)
        return float(np.linalg.norm(self.carried(self.points[-1:], share) - moved))


def _to_boxes(m: Float, centre: Float) -> Float:
    """Return the distances `(K,)` from the origin to boxes `centre + m e`, e within half a unit each way."""
    e = np.zeros_like(centre)
    for _ in range(SWEEPS):
        for n in range(3):
            rest = centre + np.einsum("kij,kj->ki", m, e) - m[:, :, n] * e[:, n, None]
            best = -(rest * m[:, :, n]).sum(axis=1) / (m[:, :, n] ** 2).sum(axis=1)
            e[:, n] = np.clip(best, -0.5, 0.5)
    return np.linalg.norm(centre + np.einsum("kij,kj->ki", m, e), axis=1)
