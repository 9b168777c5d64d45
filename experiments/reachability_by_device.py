"""What share of the lung a device reaches: diameter of the bronchoscope x radius of curvature of the needle.

    python -m experiments.reachability_by_device [--quick] [--results FOLDER] [--patients NAME ...]

All other sizes are those of one system.  The share is that of a grid of points in free lung tissue that a
single arc, proved clear, reaches from a deployment of the atlas; what only paths of several arcs reach is not
counted.  Fissures may be crossed.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from matplotlib.figure import Figure

import lungaccess as la
from anatomy.base.records import frozen_value
from anatomy.base.typed import Float
from anatomy.lung import Lung
from experiments.support.anatomies import anatomy, default_anatomies
from experiments.support.results import Result, setting_of, study_parser, write_result
from lungaccess.planning.reachability import map_reach
from lungaccess.problem.system import System
from lungaccess.showing.report import style


@frozen_value
class Size:
    """Diameters of the scope and radii of curvature, mm, and the spacing of the points, mm."""

    scopes_mm: tuple[float, ...]
    radii_mm: tuple[float, ...]
    spacing_mm: float


FULL = Size(
    scopes_mm=(2.5, 3.0, 3.5, 4.0, 4.9, 6.0), radii_mm=(30.0, 50.0, 75.0, 100.0, 121.0, 200.0), spacing_mm=6.0
)
QUICK = Size(scopes_mm=(3.0, 4.9), radii_mm=(50.0, 121.0), spacing_mm=12.0)


def with_scope(system: System, diameter_mm: float) -> System:
    """Return a system with another bronchoscope, in which fissures may be crossed."""
    scope = replace(system.scope, outer_diameter_mm=diameter_mm)
    return replace(system, scope=scope, fissures_allowed=True)


def shares_of(lung: Lung, system: System, size: Size) -> Iterator[tuple[float, Float]]:
    """Yield for each scope its diameter and the reached shares `(R,)` by radius of curvature."""
    for diameter in size.scopes_mm:
        atlas = la.build_atlas(lung, with_scope(system, diameter))
        reached = []
        for radius in size.radii_mm:
            needle = replace(atlas.system.needle, max_curvature_per_mm=1.0 / radius)
            # Deployments do not depend on the needle.
            same = replace(atlas, system=replace(atlas.system, needle=needle))
            found = map_reach(lung, same.system, spacing_mm=size.spacing_mm, atlas=same)
            reached.append(found.total.reached)
        yield diameter, np.array(reached)


def draw(tables: dict[str, Float], size: Size) -> Figure:
    """Draw each lung's shares as a table of colours with the numbers in it."""
    figure = style.new_figure(1.2 + 4.2 * len(tables), 3.8)
    for axes, (name, shares) in zip(
        figure.subplots(1, len(tables), squeeze=False)[0], tables.items(), strict=True
    ):
        axes.imshow(shares, cmap="cividis", vmin=0.0, vmax=100.0, aspect="auto")
        for (row, column), share in np.ndenumerate(shares):
            ink = "white" if share < 55.0 else "black"
            axes.text(column, row, f"{share:.0f}", ha="center", va="center", color=ink, fontsize=8)
        axes.set_xticks(range(len(size.radii_mm)), [f"{radius:g}" for radius in size.radii_mm])
        axes.set_yticks(range(len(size.scopes_mm)), [f"{diameter:g}" for diameter in size.scopes_mm])
        axes.set(
            xlabel="radius of curvature of the needle (mm)",
            ylabel="diameter of the bronchoscope (mm)",
            title=f"{name}: tissue reached (%)",
        )
    figure.tight_layout()
    return figure


def main() -> None:
    """Run the study and store its result."""
    parser = study_parser(__doc__)
    parser.add_argument("--patients", nargs="+", default=default_anatomies())
    parser.add_argument("--system", default="ultrathin")
    options = parser.parse_args()
    size = QUICK if options.quick else FULL
    patients = options.patients[:1] if options.quick else options.patients
    result = Result(
        name="reachability_by_device", title="Lung tissue within reach, by device",
        setting=setting_of(options),
        conditions={
            "system": f"{options.system}, with other scopes and needles", "fissures": "may be crossed",
            "points": f"every {size.spacing_mm:g} mm in free lung tissue",
            "reached": "by a single arc that is proved clear, from a deployment of the atlas",
        },
    )  # fmt: skip
    tables = {}
    for name in patients:
        lung, rows = anatomy(name), []
        for diameter, shares in shares_of(lung, la.load_system(options.system), size):
            rows.append(100.0 * shares)
            for radius, share in zip(size.radii_mm, rows[-1], strict=True):
                label = f"{lung.name}: scope of {diameter:g} mm, needle of {radius:g} mm"
                result.add(label, float(share), unit="%")
        tables[lung.name] = np.array(rows)
    result.figure = draw(tables, size)
    write_result(result, options.results)


if __name__ == "__main__":
    main()
