"""The report of a crash, for those who can mend the program."""

import os
import platform
import tempfile
import traceback
from collections.abc import Sequence

from anatomy.base.errors import LungaccessError


class CrashError(LungaccessError):
    """The program itself is at fault, whatever the input was."""


def write_report(error: Exception, words: Sequence[str], version: str) -> CrashError:
    """Write what is known of a crash into a file of its own, and return the error that names the file.

    Args:
        error: Raised where no error of a user was expected.
        words: The command line without the name of the program.
        version: Of lungaccess.
    """
    system = f"Python {platform.python_version()} on {platform.platform()}"
    lines = [f"lungaccess {version}, {system}", f"command: {list(words)!r}", ""]
    lines += traceback.format_exception(error)
    try:
        file, name = tempfile.mkstemp(prefix="lungaccess-crash-", suffix=".txt")
        with open(file, "w", encoding="utf-8", errors="backslashreplace") as stream:
            stream.write("\n".join(lines))
    except OSError:
        name = f"{os.devnull}: there is no room for it"
    return CrashError(
        f"The program crashed ({type(error).__name__}: {str(error)[:200]}); that is no answer",
        expected="an answer, or an error that says what is wrong with the input",
        remedy=f"Send the report {name} to the developers; the command line and names of files in it may "
        "name a patient, so read it first",
    )
