"""What a user waits for before anything starts: imports and the reading of a device."""

from __future__ import annotations

from collections.abc import Callable


def timeraw_import_lungaccess() -> str:
    """Return the statement that asv times in a new process."""
    return "import lungaccess"


def timeraw_import_system() -> str:
    """Return the statement that asv times in a new process."""
    return "import lungaccess.problem.system"


class Presets:
    """Reading of devices with everything imported."""

    def setup(self) -> None:
        """Import outside the timed part."""
        from lungaccess.problem.system import load_system

        self.load: Callable[[str], object] = load_system

    def time_load_preset(self) -> None:
        """Read and validate one preset."""
        self.load("lung-default")
