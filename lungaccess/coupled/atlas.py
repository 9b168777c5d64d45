"""The deployment atlas: everything scope and tubes can do, enumerated once per patient and system."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from anatomy.errors import SettingsError
from anatomy.lung import Lung
from anatomy.typed import Float
from lungaccess.problem.system import System
from lungaccess.problem.task import fissures_are_obstacles
from stages.needle import StartIndex
from stages.scope import Sites, find_sites
from stages.tube import (
    DEFAULT_ROTATIONS,
    DEFAULT_STOP_MM,
    Deployments,
    TubeMechanics,
    enumerate_deployments,
    joined,
    tracking_length_mm,
)

SITE_SPACING_MM = 1.0
TURNED_COARSER = 2


@dataclass(frozen=True, kw_only=True, eq=False)
class Atlas:
    """All accepted deployments of a system in a lung; independent of any target and of the needle.

    Parameters
    ----------
    lung : Lung
    system : System
    with_fissures : bool
        Whether fissures are obstacles.
    sites : Sites
    deployments : Deployments
        `deployments.site` indexes `sites`.
    index : StartIndex
        Made from the deployments: finds those with a target in the needle's workspace, for any needle.
    build_s : float
        Seconds it took.
    """

    lung: Lung
    system: System
    with_fissures: bool
    sites: Sites
    deployments: Deployments
    index: StartIndex
    build_s: float

    def site_pose(self, site: int) -> Float:
        """Return point and tangent `(6,)` of a site."""
        return np.asarray(self.sites.poses[site])

    @cached_property
    def exit_clearance_mm(self) -> Float:
        """For each deployment `(E,)`, by how much its tip is clearer of vessels and pleura than it must be.

        A lower bound, mm, of the distance from the tip of the inner tube to vessels, pleura and, where they
        are obstacles, fissures, less the tube's radius and the margins.  Airways do not count: the tube has
        just pierced one.
        """
        names = ("vessel", "pleura", "fissure") if self.with_fissures else ("vessel", "pleura")
        tips = self.deployments.positions
        nearest = np.min([self.lung.fields[name].lower_bound_mm(tips) for name in names], axis=0)
        required = self.system.tubes.inner.radius_mm + self.system.margins.total_mm
        return np.asarray(nearest - required)

    @cached_property
    def stability(self) -> Float:
        """For each deployment `(E,)`, the least determinant of its tubes in torsion: stable above 0.

        1 is that of tubes which do not wind each other up; see `stages.tube.mechanics.Equilibrium`.
        """
        entries, tubes = self.deployments, self.system.tubes
        insertions, which = np.unique(
            np.stack([entries.inner_mm, entries.outer_mm], axis=1), axis=0, return_inverse=True
        )
        rear_ends = insertions - np.array([tubes.inner.length_mm, tubes.outer.length_mm])
        solved = TubeMechanics((tubes.inner, tubes.outer)).batch(np.zeros_like(rear_ends), rear_ends)
        return np.asarray(np.where(solved.converged, solved.least_determinant, -np.inf)[which.ravel()])


def require_same(atlas: Atlas, lung: Lung, system: System) -> None:
    """Raise SettingsError unless an atlas holds for a lung and a system: the needle does not matter."""
    made, wanted = atlas.system, system
    same = (
        atlas.lung.key == lung.key
        and (made.scope, made.tubes, made.margins) == (wanted.scope, wanted.tubes, wanted.margins)
        and atlas.with_fissures == fissures_are_obstacles(lung, wanted)
    )
    if not same:
        raise SettingsError(
            f"The atlas was made for {atlas.lung.name} and {made.name}",
            expected=f"one for {lung.name} and {wanted.name}, with the same masks, scope, tubes and margins",
            remedy="Make it with build_atlas(lung, system)",
        )


def build_atlas(
    lung: Lung,
    system: System,
    *,
    rotations: int = DEFAULT_ROTATIONS,
    stop_spacing_mm: float = DEFAULT_STOP_MM,
    site_spacing_mm: float = SITE_SPACING_MM,
    progress: Callable[[float], None] | None = None,
) -> Atlas:
    """Enumerate sites, rotations and insertions, and keep what is safe.

    Parameters
    ----------
    lung : Lung
    system : System
    rotations : int
        Evenly spaced rotations of the tubes, and further ones where tube or exit is near a limit.
    stop_spacing_mm, site_spacing_mm : float
        Spacing of insertions and of sites along the airway.
    progress : callable, optional
        Called with the share of the work done.
    """
    began = time.perf_counter()
    with_fissures = fissures_are_obstacles(lung, system)
    reach = tracking_length_mm(system.tubes)
    places = find_sites(lung, system.scope, reach_mm=reach, spacing_mm=site_spacing_mm)
    straight = int((~places.turned).sum())
    share = straight / max(places.count, 1)
    tell = progress or (lambda _share: None)

    def enumerated(poses: Float, rotations: int, spacing_mm: float, begin: float, end: float) -> Deployments:
        return enumerate_deployments(
            lung,
            system.tubes,
            system.margins,
            poses,
            with_fissures=with_fissures,
            rotations=rotations,
            stop_spacing_mm=spacing_mm,
            progress=lambda done: tell(begin + done * (end - begin)),
        )

    found = enumerated(places.poses[:straight], rotations, stop_spacing_mm, 0.0, share)
    if straight < places.count:
        # Tips turned aside look in so many directions that each of them needs fewer rotations and stops.
        coarse = max(1, rotations // TURNED_COARSER), stop_spacing_mm * TURNED_COARSER
        found = joined(found, enumerated(places.poses[straight:], *coarse, share, 1.0), straight)
    return Atlas(
        lung=lung,
        system=system,
        with_fissures=with_fissures,
        sites=places,
        deployments=found,
        index=StartIndex(found.positions, found.tangents),
        build_s=time.perf_counter() - began,
    )
