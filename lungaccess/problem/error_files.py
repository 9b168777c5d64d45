"""Read error models: the presets that ship with the package, and files of one's own."""

import functools
import os
import tomllib
from typing import Any

from anatomy.base.errors import SettingsError
from anatomy.base.settings import parse, to_mapping
from lungaccess.problem.errors import ErrorModel
from lungaccess.problem.preset_files import PresetFiles

DEFAULT_ERRORS = "breath-hold"
"""Images for planning are taken in breath hold, and so is the procedure that repeats it."""
LIKE = "like"
"""The key of a file that names the preset whose tables stand where the file has none."""
_FILES = PresetFiles(
    what="error model",
    folders=("presets/errors",),
    remedy="`lungaccess template errors` prints a complete file to start from",
    expected="tables such as [scope_position] with lines such as attempt_mm = 1.0",
)


error_preset_names = _FILES.names
"""Returns the names of the error models that ship with the package, sorted."""


@functools.cache
def _preset(name: str) -> ErrorModel:
    return parse(ErrorModel, tomllib.loads(_FILES.text(name)), name)


def load_errors(name_or_path: str | os.PathLike[str] = DEFAULT_ERRORS) -> ErrorModel:
    """Read an error model from a preset or from a TOML file.

    A table that a file leaves out is that of the preset that its key `like` names, of `breath-hold` without
    that key.  The model is called what the file says in `name`, else as the file is.

    What may be stated, and the errors, are those of `lungaccess.problem.system.load_system`.

    Examples:
        >>> load_errors("gated-ct").scope_position.attempt_mm
        1.3
    """
    given = os.fspath(name_or_path)
    if given in _FILES.names():
        return _preset(given)
    stated = _FILES.read(name_or_path)
    like = stated.pop(LIKE, DEFAULT_ERRORS)
    if not isinstance(like, str):
        raise SettingsError(
            f"{given}: {LIKE} = {like!r}", expected="the name of a preset", remedy=_FILES.remedy
        )
    base: dict[str, Any] = to_mapping(_preset(like))
    filled = {**base, "description": "", "name": os.path.basename(given), **stated}
    return parse(ErrorModel, filled, given, remedy=_FILES.remedy)
