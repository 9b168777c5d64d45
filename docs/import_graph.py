"""The rooms of the project and what imports what, read from the source: the picture of the architecture.

    python -m docs.import_graph

draws `docs/images/architecture.png`.  The core is what a plan and its check need, from masks on: all that
these modules import, directly or not, within functions, too.
"""

from __future__ import annotations

import ast
import sys
from collections import Counter
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from anatomy.base.facade import public_names

ROOT = Path(__file__).resolve().parents[1]
OURS = ("anatomy", "stages", "lungaccess")
CORE = (
    "lungaccess.problem.patients", "lungaccess.planning.one_system", "lungaccess.judging.checking.checker",
)  # fmt: skip
"""The modules that read a patient, plan for one request, and check a plan."""
ROWS = (
    ("lungaccess.cli",),
    ("lungaccess.showing", "lungaccess.running"),
    ("lungaccess.judging",),
    ("lungaccess.planning",),
    ("lungaccess.uncertainty",),
    ("lungaccess.plans",),
    ("lungaccess.problem",),
    ("stages.scope", "stages.tube", "stages.needle"),
    ("stages.scope.advisor", "stages.scope.route", "stages.scope.tour"),
    ("anatomy", "anatomy.segmentation", "anatomy.phantom"),
)
"""Rooms from the top down; a room within another one is drawn by itself."""


@cache
def sources() -> dict[str, Path]:
    """Return the file of each module."""
    found = {}
    for package in OURS:
        for file in sorted((ROOT / package).rglob("*.py")):
            parts = file.relative_to(ROOT).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = file
    return found


def imports_of(module: str) -> set[str]:
    """Return the modules that a module imports; a name of a facade counts for where it is defined."""
    found = set()
    for source, name in _imports(ast.parse(sources()[module].read_text(encoding="utf-8"))):
        if source in sources():
            file = sources()[source]
            is_facade = file.name == "__init__.py" and "lazy_exports" in file.read_text(encoding="utf-8")
            source = public_names(str(file)).get(name, source) if is_facade else source
        found |= {each for each in (source, f"{source}.{name}") if each in sources()}
    return found


def _imports(node: ast.AST) -> Iterator[tuple[str, str]]:
    """Yield module and name of all imports below a node but those for type checkers."""
    for child in ast.iter_child_nodes(node):
        if (
            isinstance(child, ast.If)
            and isinstance(child.test, ast.Name)
            and child.test.id == "TYPE_CHECKING"
        ):
            continue
        if isinstance(child, ast.ImportFrom) and child.module:
            yield from ((child.module, alias.name) for alias in child.names)
        elif isinstance(child, ast.Import):
            yield from ((alias.name, "") for alias in child.names)
        yield from _imports(child)


def core() -> set[str]:
    """Return the modules that plans and their check need."""
    found: set[str] = set()
    waiting = list(CORE)
    while waiting:
        module = waiting.pop()
        if module not in found:
            found.add(module)
            waiting += imports_of(module)
    return found


def lines_of(modules: set[str]) -> int:
    """Return how many lines modules have."""
    return sum(len(sources()[each].read_text(encoding="utf-8").splitlines()) for each in modules)


def room_of(module: str) -> str:
    """Return the smallest room that holds a module; itself, where it stands above all rooms."""
    rooms = [room for row in ROWS for room in row if f"{module}.".startswith(f"{room}.")]
    return max(rooms, key=len, default=module)


def main() -> None:
    """Draw the picture."""
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot

    needed, width, height = core(), 0.30, 0.62
    place = {
        room: ((n + 0.5) / len(row), -float(y)) for y, row in enumerate(ROWS) for n, room in enumerate(row)
    }
    figure, axes = pyplot.subplots(figsize=(9.0, 8.2), layout="constrained")
    used = Counter((room_of(module), room_of(other)) for module in sources() for other in imports_of(module))
    for (one, other), count in used.items():
        if one != other and {one, other} <= place.keys():
            (x, y), (to_x, to_y) = place[one], place[other]
            bend = 0.0 if abs(y - to_y) <= 1.0 else 0.25 if x <= to_x else -0.25
            axes.annotate(
                "", (to_x, to_y + height / 2), (x, y - height / 2), zorder=1,
                arrowprops={
                    "arrowstyle": "->", "connectionstyle": f"arc3,rad={bend}", "color": "0.6",
                    "linewidth": 0.5 + 0.03 * min(count, 60), "alpha": 0.6,
                },
            )  # fmt: skip
    for room, (x, y) in place.items():
        inside = {module for module in sources() if room_of(module) == room}
        share = lines_of(inside & needed) / lines_of(inside)
        corner = (x - width / 2, y - height / 2)
        axes.add_patch(pyplot.Rectangle(corner, width, height, facecolor="white", edgecolor="0.3", zorder=2))
        axes.add_patch(pyplot.Rectangle(corner, share * width, height, facecolor="#9ecae1", zorder=3))
        words = f"{room}\n{lines_of(inside):,} lines, {100 * share:.0f} % core"
        axes.text(x, y, words, ha="center", va="center", fontsize=8.5, zorder=4)
    axes.set(xlim=(0, 1), ylim=(-len(ROWS) + 0.4, 0.6))
    axes.set_axis_off()
    figure.savefig(ROOT / "docs" / "images" / "architecture.png", dpi=110)
    sys.stdout.write(f"The core has {lines_of(needed):,} of {lines_of(set(sources())):,} lines.\n")


if __name__ == "__main__":
    main()
