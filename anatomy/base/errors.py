"""The typed errors of every layer: what was found, what was expected, what to do."""


class LungaccessError(Exception):
    """Base of all errors that a user can cause and mend.

    The message states what was found, what was expected and what can be done about it.
    """

    def __init__(self, found: str, *, expected: str = "", remedy: str = "") -> None:
        self.found = found
        self.expected = expected
        self.remedy = remedy
        parts = [found.rstrip(".") + "."]
        if expected:
            parts.append(f"Expected: {expected.rstrip('.')}.")
        if remedy:
            parts.append(f"{remedy.rstrip('.')}.")
        super().__init__(" ".join(parts))

    def to_mapping(self) -> dict[str, str]:
        """Return its class and parts as plain JSON values."""
        stated = {"found": self.found, "expected": self.expected, "remedy": self.remedy}
        return {"kind": type(self).__name__, **stated}


class FrameError(LungaccessError):
    """A coordinate frame is missing, ambiguous or not a rigid right-handed frame."""


class GridMismatchError(FrameError):
    """Two images that must share one voxel grid do not."""


class AnatomyError(LungaccessError):
    """The anatomy cannot be what it claims: empty mask, no trachea, no lung."""


class FileError(LungaccessError):
    """A file or folder cannot be read or written, or is truncated or of another kind."""


class SettingsError(LungaccessError):
    """A device or planning setting is unknown, not finite or physically impossible."""


class MissingLibraryError(SettingsError, ImportError):
    """A setting asks for a library that is not installed, or that does not exist for this platform."""


class TargetError(LungaccessError):
    """The target is not where a target can be: outside the lung, or inside an obstacle."""


class PlanFileError(LungaccessError):
    """A stored plan is damaged, of an unknown version or another patient's; by default: plan again."""

    def __init__(
        self,
        found: str,
        *,
        expected: str = "",
        remedy: str = "Run `lungaccess plan` again for the same patient, target and system",
    ) -> None:
        super().__init__(found, expected=expected, remedy=remedy)
