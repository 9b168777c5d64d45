"""Settings by the name of a preset that ships with the package, or by the path of a TOML file."""

import os
import tomllib
from importlib import resources
from typing import Any

from anatomy.base.errors import SettingsError
from anatomy.base.files import read_toml
from anatomy.base.records import frozen_value
from anatomy.base.words import did_you_mean

_ROOM = resources.files("lungaccess.problem")


@frozen_value
class PresetFiles:
    """The presets of one kind of settings, in folders of the package, and files of one's own.

    Errors call such settings `what`, say what a file is `expected` to hold, and what to do as a `remedy`.
    """

    what: str
    folders: tuple[str, ...]
    remedy: str
    expected: str = "UTF-8 text in TOML syntax"

    def names(self) -> tuple[str, ...]:
        """Return the names of the presets, sorted in each folder."""
        return tuple(name for folder in self.folders for name in self.names_in(folder))

    @staticmethod
    def names_in(folder: str) -> tuple[str, ...]:
        """Return the names of the presets in one of the folders, sorted."""
        entries = (_ROOM / folder).iterdir()
        return tuple(sorted(each.name[:-5] for each in entries if each.name.endswith(".toml")))

    def text(self, name: str) -> str:
        """Return the TOML text of a preset, with its comments; SettingsError if there is no such preset."""
        for folder in self.folders:
            if name in self.names_in(folder):
                return (_ROOM / folder / f"{name}.toml").read_text(encoding="utf-8")
        names = self.names()
        raise SettingsError(
            f"There is no {self.what} called {name!r}",
            expected=f"a preset ({', '.join(names)}) or the path of a .toml file",
            remedy=did_you_mean(name, names) or self.remedy,
        )

    def read(self, name_or_path: str | os.PathLike[str]) -> dict[str, Any]:
        """Return the values of a preset or a ``.toml`` file; SettingsError or FileError if there is none."""
        given = os.fspath(name_or_path)
        if given in self.names() or (isinstance(name_or_path, str) and not given.endswith(".toml")):
            return tomllib.loads(self.text(given))
        return read_toml(given, expected=self.expected, remedy=self.remedy)
