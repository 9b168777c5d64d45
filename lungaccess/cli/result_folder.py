"""Where commands write: one question, one folder, one command at a time, and nothing of others is lost."""

import contextlib
import filecmp
import itertools
import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from anatomy.base.errors import FileError
from anatomy.base.files import require_writable_folder
from anatomy.base.unfinished import MARK, sole_writer
from lungaccess.cli import terminal

MOST_NAMED = 5
"""Files that a message names."""
OUTPUTS = frozenset({"--out", "--page", "--film", "--movie", "--picture", "--csv", "--parquet"})
"""Options that name what is written; none of them names what is read."""
MOVED = "{}.earlier-{}{}"
"""A file that a command would overwrite is kept under this name: stem, number and suffix."""
WRITTEN = frozenset({".png", ".svg", ".gif", ".mp4", ".html", ".csv", ".parquet", ".json"})
"""Kinds of files that commands write anew; they go on with a `.db`, and a template is no result."""
REMEDY = "Choose another with --out, or say --force where these files may be lost"

Force = Annotated[
    bool, Parameter(negative="", help="Overwrite what lies where results go; it is lost.", show_default=False)
]
"""The option of commands that would else refuse to write, or move earlier results aside."""

held = contextlib.ExitStack()
"""The locks that this command holds, which end with it."""


def claim_folder(out: Path, results: Sequence[str], *, force: bool = False) -> Path:
    """Lock a folder for the results of one command, after moving those of an earlier one aside.

    Args:
        out: Made if it is missing.
        results: Patterns of the names of all files that the command, or what shows its results, may write.
        force: Remove such files instead.

    Raises:
        FileError: If another command writes into the folder, the folder cannot be written, or such files lie
            in it which no command is known to have left there.
    """
    folder = require_writable_folder(out)
    mark, is_ours = folder / MARK, (folder / MARK).is_dir()
    found = {path for pattern in results for path in folder.glob(pattern) if path.is_file()}
    there = sorted(path for path in found if path.name[0] != ".")
    if there and not is_ours and not force:
        raise _occupied(folder, there)
    if not is_ours and not there:
        held.callback(_unmark, mark, set(os.listdir(folder)))
    mark.mkdir(exist_ok=True)
    held.enter_context(sole_writer(folder, mark))
    # The results of earlier runs are moved into a folder inside.
    aside = next(
        place
        for n in range(1, len(os.listdir(folder)) + 2)
        if not (place := folder / f"earlier-{n}").exists()
    )
    for path in there:
        if force:
            path.unlink()
            continue
        aside.mkdir(exist_ok=True)
        path.rename(aside / path.name)
    return folder


def _unmark(mark: Path, before: set[str]) -> None:
    """Take the mark from a folder in which a command that was refused has written nothing."""
    if set(os.listdir(mark.parent)) - {MARK} == before:
        shutil.rmtree(mark, ignore_errors=True)


def require_empty_folder(out: Path, *, force: bool) -> None:
    """Raise FileError unless a folder is missing or empty, or what it holds may be lost."""
    folder = require_writable_folder(out)
    if not force and (there := sorted(folder.iterdir())):
        raise _occupied(folder, there)


def keep_earlier(path: Path) -> None:
    """Move a result that lies where one is to be written aside until the command ends.

    It comes back if no other one was written, goes if the new one is the same, and else stays beside it.
    """
    if path.suffix.lower() not in WRITTEN or path.is_symlink() or not path.is_file():
        return
    names = (MOVED.format(path.stem, n, path.suffix) for n in itertools.count(1))
    aside = next(there for name in names if not (there := path.with_name(name)).exists())
    path.rename(aside)
    held.callback(_settle, path, aside)


def _settle(path: Path, aside: Path) -> None:
    if not path.exists():
        aside.rename(path)
    elif filecmp.cmp(path, aside, shallow=False):
        aside.unlink()
    else:
        terminal.progress_console.print(f"The earlier {path} is kept as {aside.name}.", soft_wrap=True)


def require_new_file(path: Path, *, force: bool) -> None:
    """Raise FileError if there is a file of that name, unless it may be lost."""
    if path.exists() and not force:
        raise FileError(f"{path} exists already", expected="a file that is not there yet", remedy=REMEDY)


def _occupied(folder: Path, there: Sequence[Path]) -> FileError:
    names = ", ".join(path.name for path in there[:MOST_NAMED])
    more = f" and {len(there) - MOST_NAMED} more" if len(there) > MOST_NAMED else ""
    return FileError(
        f"{folder} holds {names}{more}, which this command would overwrite or mix with its results",
        expected="a folder of results, or one without such files",
        remedy=REMEDY,
    )


def protect_files(words: Sequence[str]) -> None:
    """Keep results that a command line wants overwritten, see `keep_earlier`.

    Raises:
        FileError: If a file that is to be written is, or lies in, what is to be read: new files may be
            written beside inputs; those that are there may not be overwritten.
    """
    pairs = [word.partition("=")[::2] for word in words]
    written = [value for name, value in pairs if name in OUTPUTS and value]
    written += [after for word, after in zip(words, words[1:], strict=False) if word in OUTPUTS]
    read = {*words, *(value for name, value in pairs if name not in OUTPUTS)} - {*written, ""}
    read |= {name for name in written if (*words,).count(name) > 1}
    inputs = [
        Path(name) for each in read for name in {each, each.partition("#")[0]} if name and _exists(name)
    ]
    for output in map(Path, written):
        found = [each for each in inputs if _exists(output) and output.is_file() and _holds(each, output)]
        if found:
            raise FileError(
                f"{output} would be overwritten, but is an input of this command ({found[0]})",
                expected="results in files of their own",
                remedy="Choose another file with --out",
            )
    for output in filter(_exists, map(Path, written)):
        keep_earlier(output)


def _exists(path: str | Path) -> bool:
    try:
        return os.path.exists(path)
    except ValueError:
        return False


def _holds(place: Path, path: Path) -> bool:
    return place.samefile(path) or (place.is_dir() and path.resolve().parent == place.resolve())
