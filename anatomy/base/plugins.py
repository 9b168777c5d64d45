"""What other packages add: goals and planners that they register as entry points of Python.

A package states, for instance in its ``pyproject.toml``::

    [project.entry-points."lungaccess.goals"]
    bifurcations = "their_package.goals:bifurcations"

From then on the name is known to the command line, to studies and to Python alike.
"""

from functools import cache
from importlib.metadata import entry_points
from typing import Any

from anatomy.base.errors import SettingsError


@cache
def registered(group: str) -> dict[str, Any]:
    """Return what other packages register in a group, by its name.

    Raises SettingsError if something that is registered cannot be imported.
    """
    found = {}
    for each in entry_points(group=group):
        try:
            found[each.name] = each.load()
        except Exception as error:
            raise SettingsError(
                f"{each.name!r}, which a package registers as one of {group}, cannot be imported: {error}",
                expected=f"an object at {each.value}",
                remedy="Mend that package, or remove it",
            ) from error
    return found
