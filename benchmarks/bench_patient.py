"""From a synthetic patient to a plan: time and memory of every step, on the small and the adult patient."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

import lungaccess as la
from anatomy.build import build_lung
from anatomy.phantom import make_phantom
from anatomy.store import open_lung
from lungaccess.problem.target import point_target
from stages.needle.environment import needle_environment, workspace_lengths

SYSTEM = "ultrathin"
SEED = 3
TARGET_LPS = (-45.6, 47.0, -65.1)
"""A point of the small patient to which many direct arcs are clear."""


class Anatomy:
    """Images to lung, and lung from the cache."""

    params = ("small", "adult")
    param_names = ("size",)
    timeout = 300

    def setup(self, size: str) -> None:
        """Make the patient once and fill a cache."""
        self.images = make_phantom(seed=SEED, size=size).images
        self.cache = Path(tempfile.mkdtemp())
        open_lung(dict(self.images.sources), lambda: self.images, cache=self.cache)

    def teardown(self, size: str) -> None:
        """Empty the cache."""
        shutil.rmtree(self.cache)

    def time_phantom(self, size: str) -> None:
        """Synthetic patient."""
        make_phantom(seed=SEED, size=size)

    def time_build(self, size: str) -> None:
        """Tree, labels, septum and clearance fields."""
        build_lung(self.images)

    def time_cached(self, size: str) -> None:
        """The same from the cache."""
        open_lung(dict(self.images.sources), lambda: self.images, cache=self.cache)

    def peakmem_build(self, size: str) -> None:
        """Peak memory of the build."""
        build_lung(self.images)


class Planning:
    """Atlas, first plan, check, and the two scans that a query consists of."""

    timeout = 300

    def setup_cache(self) -> Any:
        """Return a target that can be reached."""
        return list(TARGET_LPS)

    def setup(self, target: list[float]) -> None:
        """Make lung, atlas and plan."""
        self.lung = build_lung(make_phantom(seed=SEED, size="small").images)
        self.system = la.load_system(SYSTEM)
        self.atlas = la.build_atlas(self.lung, self.system)
        self.target = point_target(self.lung, np.array(target))
        self.found = next(self._plans())
        self.environment = needle_environment(
            self.lung, self.system.needle, self.system.margins, with_fissures=self.atlas.with_fissures
        )

    def _plans(self) -> Any:
        return la.plan(self.lung, self.system, self.target, atlas=self.atlas, goal="default")

    def time_atlas(self, target: list[float]) -> None:
        """Find motions of the scope, enumerate deployments."""
        la.build_atlas(self.lung, self.system)

    def track_atlas_entries(self, target: list[float]) -> int:
        """Accepted deployments."""
        return self.atlas.deployments.count

    def time_first_plan(self, target: list[float]) -> None:
        """Query the atlas until the first plan."""
        next(self._plans())

    def time_500_iterations(self, target: list[float]) -> None:
        """Improve a plan."""
        for _ in la.plan(
            self.lung, self.system, self.target, atlas=self.atlas, iterations=500, goal="default"
        ):
            pass

    def time_workspace_scan(self, target: list[float]) -> None:
        """Test every deployment for the target."""
        entries = self.atlas.deployments
        workspace_lengths(self.environment, entries.positions, entries.tangents, self.target.lps_mm)

    def time_replan_from_scope(self, target: list[float]) -> None:
        """Plan tubes and needle from the scope's tip as measured."""
        la.replan_from_scope(self.lung, self.system, self.found.scope.lps_from_scope_tip, self.target)

    def time_replan_from_tube(self, target: list[float]) -> None:
        """Plan the needle from the tubes' tip as measured."""
        la.replan_from_tube(self.lung, self.system, self.found.tube.lps_from_tip, self.target)

    def time_check(self, target: list[float]) -> None:
        """Check a plan."""
        la.check(self.found, self.lung)
