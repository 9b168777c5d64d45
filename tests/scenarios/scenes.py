"""Lungs, systems and atlases of the scenarios, each made once.

Synthetic lungs and all atlases are made by the code under test; real lungs come from the cache.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import lungaccess as la
from anatomy.build import build_lung
from anatomy.lung import Lung
from anatomy.phantom import make_phantom
from lungaccess.judging.checking import Checker
from lungaccess.problem.system import System
from tests.scenarios.cases import Anatomy, Case


@dataclass(kw_only=True)
class Scenes:
    """All scenes that were asked for; `data` is the folder of real anatomy."""

    data: Path | None = None
    _made: dict[Any, Any] = field(default_factory=dict)

    def lung(self, anatomy: Anatomy) -> Lung:
        """Return the lung of an anatomy."""
        return self._once(("lung", anatomy), lambda: self._lung(anatomy))

    def checker(self, anatomy: Anatomy) -> Checker:
        """Return the judge of plans for an anatomy."""
        return self._once(("checker", anatomy), lambda: Checker(self.lung(anatomy)))

    def system(self, anatomy: Anatomy, device: str) -> System:
        """Return a device as it is used in an anatomy."""
        preset = la.load_system(device)
        if not anatomy.fissures_allowed:
            return preset
        return replace(preset, name=f"{device}, fissures allowed", fissures_allowed=True)

    def atlas(self, case: Case) -> la.Atlas:
        """Return the atlas of a case; devices that differ in their needle share one."""
        system = self.system(case.anatomy, case.device)
        key = (case.anatomy, repr((system.scope, system.tubes, system.margins)))
        return self._once(key, lambda: la.build_atlas(self.lung(case.anatomy), system))

    def _lung(self, anatomy: Anatomy) -> Lung:
        if anatomy.seed is not None:
            made = make_phantom(seed=anatomy.seed, size="small", spacing_mm=anatomy.spacing_mm)
            return build_lung(made.images)
        if self.data is None:
            raise FileNotFoundError(f"{anatomy.name} needs the folder of real anatomy")
        return la.load_patient(self.data / "med-rad" / anatomy.name)

    def _once(self, key: Any, make: Any) -> Any:
        if key not in self._made:
            self._made[key] = make()
        return self._made[key]
