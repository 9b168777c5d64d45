"""Scope tips of a case: where a scope can stand, with the motion that leads there.

They let a planner start from a bronchoscope without having one of its own.  A submission names one by number.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from anatomy.base.errors import SettingsError
from anatomy.base.files import read_json
from anatomy.lung import Lung
from lungaccess.planning.coupled.atlas import motions_of
from lungaccess.problem.system import load_system

SPACING_MM = 5.0
"""The tips lie this far apart along the airway: a handful in every segmental bronchus."""
DIGITS = 7
"""States are rounded to so many in mm and rad: the check allows a micrometre at the tip."""


def tips_file(system: str) -> str:
    """Return the name of the file of tips of a device, in the folder of a phantom."""
    return f"tips-{system}.json"


def scope_tips(lung: Lung, system: str) -> dict[str, Any]:
    """Return places where the scope of a device can stand, each with the motion that leads there.

    `lps_from_entry` is one for all; each of `tips` has `lps_from_tip` (4x4, LPS mm) and `states` of advance
    in mm, twist and bend in rad; see `lungaccess.plans.parts.ScopeInsertion`.
    """
    motions = motions_of(lung, load_system(system), SPACING_MM)
    found = []
    for number in range(motions.count):
        motion = motions.motion(number)
        states = motion.states.round(DIGITS).tolist()
        found.append({"lps_from_tip": motion.lps_from_tip.tolist(), "states": states})
    return {"frame": "lps", "lps_from_entry": motions.lps_from_entry.tolist(), "tips": found}


class PublishedTips:
    """The tips in a folder of cases, read when they are first asked for."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._read: dict[tuple[str, str], Any] = {}

    def tip(self, phantom: str, system: str, number: int) -> Mapping[str, Any]:
        """Return `lps_from_entry`, `states` and `lps_from_tip` of a tip.

        Raises
        ------
        FileError
            If the file of tips cannot be read.
        SettingsError
            If there is no tip of that number.
        """
        path = self._folder / phantom / tips_file(system)
        if (phantom, system) not in self._read:
            self._read[phantom, system] = read_json(
                path, expected="published tips", remedy="Make the cases with --tips"
            )
        content = self._read[phantom, system]
        try:
            return {"lps_from_entry": content["lps_from_entry"], **content["tips"][number]}
        except (KeyError, IndexError, TypeError) as error:
            raise SettingsError(
                f"{phantom} has no published tip {number} for {system}",
                expected=f"a number of the list `tips` in {path.name}",
                remedy="Name another tip, or state lps_from_entry, states and lps_from_tip",
            ) from error
