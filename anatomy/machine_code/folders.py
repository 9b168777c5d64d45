"""Where machine code of kernels is kept, and where it may have been made beforehand."""

import os
import sys
import tempfile
import warnings
from functools import cache
from importlib import util
from pathlib import Path

from anatomy.base.cache import user_cache
from anatomy.machine_code.sources import version_of


class KernelsNotKeptWarning(UserWarning):
    """Machine code cannot be kept, or what was made beforehand does not fit: kernels are compiled."""


def kernels_folder() -> Path:
    """Return where code is kept: `lungaccess-kernels` in `$NUMBA_CACHE_DIR`, or else in the user's cache."""
    stated = os.environ.get("NUMBA_CACHE_DIR")
    return (Path(stated) if stated else user_cache()) / "lungaccess-kernels"


@cache
def generation() -> str:
    """Return the name of the folder for this numba and Python: neither reads what another one made."""
    return f"numba-{version_of('numba')}-{sys.implementation.cache_tag}"


@cache
def _prebuilt_folder() -> Path | None:
    """Return the folder of code that was made beforehand for this numba and Python, if there is one."""
    # Package with machine code that was made beforehand.
    spec = util.find_spec("lungaccess_kernels")
    for root in (spec.submodule_search_locations or ()) if spec else ():
        made = Path(root)
        if (made / generation()).is_dir():
            return made / generation()
        there = ", ".join(sorted(each.name for each in made.glob("numba-*"))) or "nothing"
        say_once(f"lungaccess-kernels holds {there}, here is {generation()}: kernels are compiled instead")
    return None


def code_folders() -> tuple[Path, ...]:
    """Return where code is looked for, in this order; new code is kept in the last."""
    prebuilt = _prebuilt_folder()
    return (*(() if prebuilt is None else (prebuilt,)), kernels_folder() / generation())


def can_be_written(folder: Path) -> bool:
    """Tell whether files can be made in a folder; it is made if it is not there."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        return False
    return True


def module_folder(module: str, stamp: str) -> str:
    """Return the name of the folder for the kernels of a module, as its sources are."""
    return f"{module}-{stamp[:12]}"


@cache
def say_once(message: str) -> None:
    """Warn of something once."""
    warnings.warn(message, KernelsNotKeptWarning, stacklevel=3)
