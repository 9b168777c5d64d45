"""Machine code on disk, a file for each kernel, kinds of arguments, and content of its sources.

A file is found by a name that says all of this, and states it within: another content of the sources,
another numba or processor is another file.  There is no index that two processes could write at once, and a
damaged file counts as none.  `lungaccess-kernels`, where it is installed, has files that were made
beforehand: they are looked at first, and never written.
"""

import contextlib
import hashlib
import os
import pickle
import shutil
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any

from numba.core import caching, compiler, serialize

from anatomy.machine_code.ahead import first_compilation
from anatomy.machine_code.folders import code_folders, kernels_folder, module_folder, say_once
from anatomy.machine_code.sources import running

_SEAL_BYTES = 32


class KernelCache(caching._Cache):  # type: ignore[misc]
    """The machine code of one kernel on disk; numba's dispatcher asks it before it compiles.

    It is made of the kernel before it was decorated, while its module is imported.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function
        self._stamp = running.stamp(function.__module__)
        self._enabled = self._stamp is not None
        self._folder = module_folder(function.__module__, self._stamp or "")

    @property
    def cache_path(self) -> str:
        """The folder in which new code of this kernel is kept."""
        return str(self._kept_in())

    def _kept_in(self) -> Path:
        return code_folders()[-1] / self._folder

    def enable(self) -> None:
        """Look for code, and keep it."""
        self._enabled = self._stamp is not None

    def disable(self) -> None:
        """Neither look for code nor keep any."""
        self._enabled = False

    def flush(self) -> None:
        """Forget the code of all kernels of this module."""
        shutil.rmtree(self._kept_in(), ignore_errors=True)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the compiled function for these kinds of arguments, None if it is not on disk."""
        target_context.refresh()
        if not self._enabled:
            return None
        key = self._key(sig, target_context.codegen())
        stored = self._stored(key)
        if stored is None and first_compilation.prepare():
            stored = self._stored(key)
        return None if stored is None else compiler.CompileResult._rebuild(target_context, *stored)

    def code_file(self, sig: Any, target_context: Any) -> Path | None:
        """Return the file of the code for these kinds of arguments, None if there is none."""
        target_context.refresh()
        name = self._file(self._key(sig, target_context.codegen()))
        paths = (folder / self._folder / name for folder in code_folders())
        return next((path for path in paths if path.is_file()), None)

    def _stored(self, key: tuple[Any, ...]) -> Any:
        name = self._file(key)
        found = (_stored(folder / self._folder / name, key) for folder in code_folders())
        return next((each for each in found if each is not None), None)

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep a compiled function; where nothing can be written it serves this process alone."""
        if not self._enabled or any(not each.can_cache for each in data.lifted):
            return
        if data.library.has_dynamic_globals:
            return
        key = self._key(sig, data.codegen)
        try:
            made = serialize.dumps((key, data._reduce()))
        except RuntimeError:
            # Numba has no object code of a library that runs, once in many thousands: it serves this process.
            return
        folder = self._kept_in()
        try:
            if not folder.is_dir():
                folder.mkdir(parents=True, exist_ok=True)
                contents = folder.parent.glob(f"{folder.name.rpartition('-')[0]}-*")
                with contextlib.suppress(OSError):  # One of them may vanish meanwhile.
                    # Contents of a few branches and versions in turn are kept.
                    for old in sorted(contents, key=lambda each: each.stat().st_mtime)[:-4]:
                        shutil.rmtree(old, ignore_errors=True)
            _write(folder / self._file(key), hashlib.sha256(made).digest() + made)
        except OSError as error:
            say_once(
                f"Compiled kernels cannot be kept in {kernels_folder()} ({error.strerror or error}): each "
                "process compiles them anew. Name a folder that can be written in NUMBA_CACHE_DIR"
            )

    def _key(self, sig: Any, codegen: Any) -> tuple[Any, ...]:
        """Return what the code depends on: sources, kinds of arguments, processor, and enclosed values."""
        code, cells = self._function.__code__, self._function.__closure__ or ()
        enclosed = serialize.dumps(tuple(each.cell_contents for each in cells))
        place = (self._function.__qualname__, code.co_firstlineno, hashlib.sha256(code.co_code).hexdigest())
        return (self._stamp, place, hashlib.sha256(enclosed).hexdigest(), codegen.magic_tuple(), sig)

    def _file(self, key: tuple[Any, ...]) -> str:
        """Return the name of the file for a key; two keys of one name are told apart within it."""
        return f"{self._function.__name__}-{hashlib.sha256(str(key).encode()).hexdigest()[:20]}.code"


def _stored(path: Path, key: tuple[Any, ...]) -> Any:
    """Return what is stored in a file under a key, None if there is no such file or it cannot be read."""
    try:
        content = path.read_bytes()
    except OSError:
        return None
    seal, made = content[:_SEAL_BYTES], content[_SEAL_BYTES:]
    if hashlib.sha256(made).digest() != seal:
        return None
    try:
        stated, reduced = pickle.loads(made)
    except (ImportError, AttributeError):
        # A kind of argument has moved to another module since: its name alone is part of the file's name.
        return None
    return reduced if stated == key else None


def _write(path: Path, content: bytes) -> None:
    """Write a file under a temporary name and rename it; where it is open elsewhere, that one stays."""
    temporary = path.with_name(f".{uuid.uuid4().hex}")
    try:
        temporary.write_bytes(content)
        with contextlib.suppress(PermissionError):
            os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
