"""Folders that a process is filling: a lock tells whether that process still lives."""

import contextlib
import shutil
import time
import uuid
from collections.abc import Iterator
from pathlib import Path

from filelock import FileLock, SoftFileLock, Timeout

from anatomy.base.cache import BUILDING
from anatomy.base.errors import FileError

SECONDS_PER_DAY = 24 * 3600.0
LOCK, CONTENT = "lock", "content"
"""The lock of a folder, and what is filled beside it: Windows renames no folder in which a file is open."""


@contextlib.contextmanager
def filled_folder(parent: Path) -> Iterator[Path]:
    """Make a folder under a lock, which the system takes back when this process ends, however it ends.

    What is left of the folder at the end of the block is removed.  Raises OSError if the folder cannot be
    made.
    """
    while True:
        # The name is known before the folder is made: an interrupt between the two leaves nothing behind.
        folder = parent / f"{BUILDING}{uuid.uuid4().hex}"
        with contextlib.ExitStack() as stack:
            stack.callback(shutil.rmtree, folder, ignore_errors=True)
            folder.mkdir(mode=0o700)
            if _is_taken(folder, stack):
                yield folder / CONTENT
                return


def _is_taken(folder: Path, stack: contextlib.ExitStack) -> bool:
    """Lock a new folder, unless another process removes it meanwhile as one that nobody fills."""
    with contextlib.suppress(FileNotFoundError, BlockingIOError):
        stack.enter_context(locked(folder))
        (folder / CONTENT).mkdir(mode=0o700)
        return True
    return False


MARK = ".lungaccess"
"""A folder of results holds this one: by it the folder is known, and in it lies the lock."""


@contextlib.contextmanager
def sole_writer(results: Path, folder: Path, name: str = LOCK) -> Iterator[None]:
    """Hold a lock in a folder as the one command that writes results.

    Raises FileError if another process holds it.
    """
    with contextlib.ExitStack() as stack:
        try:
            stack.enter_context(locked(folder, name))
        except BlockingIOError as error:
            raise FileError(
                f"Another command writes its results into {results}",
                expected="one command at a time for each folder or file of results",
                remedy="Wait until it has ended, or choose another place with --out",
            ) from error
        yield


@contextlib.contextmanager
def locked(folder: Path, name: str = LOCK) -> Iterator[bool]:
    """Hold a lock of a folder; yield whether there is one: some file systems have none.

    Raises BlockingIOError if another process holds it, and FileNotFoundError if there is no such folder.
    """
    lock, there = FileLock(folder / name), True
    try:
        lock.acquire(blocking=False)
    except FileNotFoundError:
        raise
    except (OSError, NotImplementedError) as error:
        there = isinstance(error, Timeout)
    there = there and not isinstance(lock, SoftFileLock)
    if there and not lock.is_locked:
        raise BlockingIOError(f"Another process fills {folder}")
    try:
        yield there
    finally:
        lock.release()


def is_abandoned(path: Path) -> bool:
    """Tell whether nobody fills or empties a path any longer: by its lock, without one after a day."""
    # No anatomy takes so long to prepare: what is older and bears no lock was left behind.
    aged = time.time() - path.stat().st_mtime > SECONDS_PER_DAY
    if not path.is_dir():
        return aged
    if not (path / LOCK).exists():
        return True
    try:
        with locked(path) as there:
            return there or aged
    except BlockingIOError:
        return False


def clear_abandoned(folder: Path) -> None:
    """Remove a folder that nobody fills; see `locked` for what is raised."""
    with locked(folder):
        shutil.rmtree(folder, ignore_errors=True)
    # Windows removes no file that is open, as the lock was.
    shutil.rmtree(folder, ignore_errors=True)


def clear_place(path: Path) -> None:
    """Remove what stands where something is to be stored, a folder or a file."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)
