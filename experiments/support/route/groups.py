"""The four groups of tubes for routes as in [Li2021], and starts and goals in them.

The paper's images cannot be had; the groups keep its limits and number of dimensions:

    G1  drawings of winding vessels, 0.68 mm a pixel                 0.08 per mm
    G2  drawings of straighter vessels, 0.37 mm a pixel              0.10 per mm
    G3  hepatic and portal veins, two airway trees; where            0.08 per mm
        LUNGACCESS_DATA is not set, the airways of two phantoms
    G4  the airways of a synthetic child                             0.20 per mm
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from anatomy.io import read_mask
from anatomy.io.centerlines import read_centerlines
from anatomy.phantom import make_phantom
from experiments.support.anatomies import PHANTOM, anatomy, data_folder, require_data
from stages.scope.route.centreline import Centreline, from_image, from_lung, from_mask, from_tree
from stages.scope.route.guide_path import Links, NoRouteError, fewest_hops, nearest_links

LIMITS_PER_MM = {"G1": 0.08, "G2": 0.10, "G3": 0.08, "G4": 0.20}
"""Limits of curvature of the paper's groups, 1/mm."""
TRIALS = {"G1": 250, "G2": 150, "G3": 200, "G4": 100}
"""[Li2021, table 1]."""
NOISE_MM = 0.5
"""Standard deviation of the noise on starts and goals: a voxel or so."""
NARROWEST_MM = 0.45
"""Trials keep to where a device of the paper fits."""
NEAREST_ENDS_MM = 20.0
"""Nearer ends need no route."""


@frozen_record
class Tubes:
    """Tubes to plan in, their links between points of the centreline, and the point at which trials begin."""

    name: str
    centreline: Centreline
    links: Links
    root: int


@frozen_record
class Trial:
    """Start and goal."""

    tubes: Tubes
    start: Float
    goal: Float
    seed: int


def tubes(name: str, centreline: Centreline) -> Tubes:
    """Prepare tubes; the root is the end with the widest tube behind it."""
    ends = np.flatnonzero(np.bincount(centreline.edges.ravel(), minlength=centreline.n_nodes) == 1)

    def width(node: int) -> float:
        near = np.linalg.norm(centreline.nodes_mm - centreline.nodes_mm[node], axis=1) < 15.0
        return float(np.median(centreline.radius_mm[near]))

    centreline.depth_mm(centreline.nodes_mm[:1])
    return Tubes(
        name=name, centreline=centreline, links=nearest_links(centreline), root=int(max(ends, key=width))
    )


def draw_vessels(seed: int, *, pixel_mm: float, wave_mm: float, height_mm: float) -> Float:
    """Draw a winding vessel with two side branches, `(rows, columns)` bool."""
    rng = np.random.default_rng(seed)
    x = np.arange(0.0, 170.0, 0.2)
    phase = rng.uniform(0.0, 2.0 * np.pi)
    y = 60.0 + height_mm * np.sin(2.0 * np.pi * x / wave_mm + phase)
    lines = [(np.stack((x + 10.0, y), axis=1), np.linspace(6.5, 4.5, len(x)))]
    for at in rng.choice(np.arange(250, 650), 2, replace=False):
        run = np.arange(0.0, 45.0, 0.2)
        slope = np.arctan2(y[at + 1] - y[at], 0.2) + rng.choice((-1.0, 1.0)) * rng.uniform(0.5, 0.8)
        branch = lines[0][0][at] + run[:, None] * (np.cos(slope), np.sin(slope))
        lines.append((branch, np.linspace(4.0, 2.5, len(run))))
    shape = (round(120.0 / pixel_mm), round(190.0 / pixel_mm))
    picture = np.zeros(shape, dtype=bool)
    for points, radius in lines:
        for (px, py), r in zip(points / pixel_mm, radius / pixel_mm, strict=True):
            i0, j0 = max(int(py - r) - 1, 0), max(int(px - r) - 1, 0)
            ii, jj = np.mgrid[i0 : int(py + r) + 2, j0 : int(px + r) + 2]
            inside = ((ii - py) ** 2 + (jj - px) ** 2 <= r * r) & (ii < shape[0]) & (jj < shape[1])
            picture[ii[inside], jj[inside]] = True
    return picture


def load_group(name: str) -> list[Tubes]:
    """Return the tubes of a group."""
    if name == "G1":
        made = [draw_vessels(s, pixel_mm=0.68, wave_mm=70.0, height_mm=14.0) for s in range(5)]
        return [tubes(f"drawing {s}", from_image(d, pixel_mm=0.68)) for s, d in enumerate(made)]
    if name == "G2":
        made = [draw_vessels(100 + s, pixel_mm=0.37, wave_mm=90.0, height_mm=9.0) for s in range(3)]
        return [tubes(f"drawing {s}", from_image(d, pixel_mm=0.37)) for s, d in enumerate(made)]
    if name == "G4":
        return [_synthetic_child(2)]
    if data_folder() is None:
        return [tubes("airway of the phantom", from_lung(anatomy(PHANTOM))), _synthetic_child(4)]
    return _veins_and_airways()


def _synthetic_child(seed: int) -> Tubes:
    lumen = make_phantom(seed=seed, size="small").images.lumen
    return tubes(f"synthetic child {seed}", from_mask(lumen, rounded=True))


def _veins_and_airways() -> list[Tubes]:
    liver = require_data("med-rad-liver/Patient1")
    found = [
        tubes(vein, from_mask(read_mask(liver / f"{vein}.nii.gz"), rounded=True))
        for vein in ("hepaticVein", "portalVein")
    ]
    lung = anatomy("Patient1")
    found.append(tubes(f"airway of {lung.name}", from_lung(lung)))
    (file,) = require_data("airway-tree").glob("*.vtu")
    return [*found, tubes("airway tree", from_tree(read_centerlines(file, frame="lps")))]


def trials(group: list[Tubes], count: int, seed: int) -> Iterator[Trial]:
    """Draw starts near the root and goals anywhere, in turn in all tubes of the group."""
    rng = np.random.default_rng(seed)
    for number in range(count):
        yield _trial(group[number % len(group)], rng, number)


def _trial(each: Tubes, rng: np.random.Generator, number: int) -> Trial:
    line = each.centreline
    wide = np.flatnonzero(line.radius_mm > NARROWEST_MM)
    while True:
        try:
            path = fewest_hops(each.links, each.root, int(rng.choice(wide)))
        except NoRouteError:
            continue
        path = path[rng.integers(max(len(path) // 3, 1)) :]
        noise = rng.normal(0.0, NOISE_MM, (2, 3))
        if np.ptp(line.nodes_mm[:, 2]) == 0.0:
            noise[:, 2] = 0.0
        start, goal = line.nodes_mm[path[[0, -1]]] + noise
        far = np.linalg.norm(goal - start) >= NEAREST_ENDS_MM
        inside = (line.depth_mm(np.stack((start, goal))) > 0.2).all()
        if far and inside and line.radius_mm[path].min() > NARROWEST_MM:
            return Trial(tubes=each, start=start, goal=goal, seed=number)
