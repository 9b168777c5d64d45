"""Published queries as the needle stage takes them, by our rules or those of the peer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from anatomy.liver import LiverImages
from anatomy.organ import Organ
from anatomy.patient import PatientImages
from lungaccess.planning.one_stage import needle_question
from lungaccess.problem.system import System
from lungaccess.running.benchmark.published import PublishedQuery
from lungaccess.running.benchmark.unc_rules import unc_needle, unc_obstacles
from stages.needle import NeedleEnvironment, Query

Pose = Callable[[PublishedQuery, float], tuple[NeedleEnvironment, Query]]
"""Makes the environment and the question of a published query with a needle of some radius in mm."""


def posed_in_lung(lung: Organ, system: System) -> Pose:
    """Return what poses queries by our rules: those of `lungaccess needle` with a system."""

    def pose(published: PublishedQuery, radius_mm: float) -> tuple[NeedleEnvironment, Query]:
        device = system.require_needle("A query of the needle")
        needle = replace(device, max_curvature_per_mm=1.0 / radius_mm)
        asked = needle_question(
            lung, replace(system, needle=needle), published.lps_from_start, published.target_lps
        )
        return asked.environment, asked.query

    return pose


def posed_by_unc(images: PatientImages | LiverImages) -> Pose:
    """Return what poses queries by the rules of the peer; see `lungaccess.running.benchmark.unc_rules`."""
    obstacles = unc_obstacles(images)

    def pose(published: PublishedQuery, radius_mm: float) -> tuple[NeedleEnvironment, Query]:
        environment = obstacles.environment(
            unc_needle(radius_mm), published.lps_from_start, published.target_lps
        )
        return environment, Query(lps_from_start=published.lps_from_start, target=published.target_lps)

    return pose
