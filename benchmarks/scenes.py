"""What the growing workloads work on, by size."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Array, Float, Int16, Mask
from anatomy.grid import Grid

if TYPE_CHECKING:
    from anatomy.lung import Lung
    from anatomy.patient import PatientImages
    from lungaccess.planning.coupled.atlas import Atlas
    from lungaccess.planning.coupled.search.atlas_search import AtlasSearch
    from stages.needle.environment import NeedleEnvironment
    from stages.scope.tour.subtree import Subtree
    from stages.tube.mechanics import TubeMechanics


OBSTACLE_SHARE = 1e-4
PHANTOM_SEED = 3
COARSEST_MM = 1.75
JITTER_MM, JITTER_RAD = 0.5, 0.05
BOX_MM = 250.0
INDEX_TARGETS = 20
SOLVES = 400
TOUR_MODELS = 5
TUBE_MM = (200.0, 160.0, 120.0, 100.0, 80.0)
TUBE_DIAMETERS_MM = ((0.3, 0.1), (0.7, 0.5), (1.1, 0.9), (1.5, 1.3), (1.9, 1.65))


def obstacles(edge: int) -> tuple[Grid, Mask]:
    """Return scattered obstacles in a cube of `edge` voxels a side, at the same density for all sizes."""
    mask = np.asfortranarray(np.random.default_rng(0).random((edge,) * 3, np.float32) < OBSTACLE_SHARE)
    return Grid.from_spacing(mask.shape, (0.6, 0.6, 0.7), (0.0, 0.0, 0.0)), mask


@frozen_record
class Chest:
    """A CT and its masks, `(n, n, n)` and Fortran-contiguous."""

    grid: Grid
    hu: Int16
    lung: Mask
    vessels: Mask
    lumen: Mask
    wall: Mask


def chest(edge: int) -> Chest:
    """Return a synthetic chest resampled to a cube of `edge` voxels a side, the same chest at all sizes."""
    from anatomy.phantom import make_phantom

    made = make_phantom(seed=PHANTOM_SEED, size="small")
    at = [np.arange(edge) * n // edge for n in made.grid.shape]

    def resampled(array: Array) -> Array:
        return np.asfortranarray(array[np.ix_(*at)])

    images = made.images
    lumen, vessels = resampled(images.lumen.array), resampled(images.vessels.array)
    lung = resampled(images.lung.array)
    spacing = made.grid.spacing_mm * np.array(made.grid.shape) / edge
    return Chest(
        grid=Grid.from_spacing((edge,) * 3, spacing, (0.0, 0.0, 0.0)),
        hu=resampled(made.ct.array),
        lung=lung,
        vessels=vessels & ~lumen,
        lumen=lumen,
        wall=np.zeros_like(lumen),
    )


def images(edge: int) -> PatientImages:
    """Return the masks of a synthetic patient, drawn in voxels so fine that they number about `edge`^3."""
    from anatomy.phantom import make_phantom

    coarse = make_phantom(seed=PHANTOM_SEED, size="small", spacing_mm=COARSEST_MM).grid
    volume = float(np.prod(np.array(coarse.shape, dtype=float) * coarse.spacing_mm))
    spacing = math.cbrt(volume) / edge
    return make_phantom(seed=PHANTOM_SEED, size="small", spacing_mm=float(spacing)).images


def direct_search(targets: int) -> tuple[Callable[[Float], AtlasSearch], Float]:
    """Return what makes a search for a point of a synthetic lung, and peripheral points."""
    from lungaccess.planning.coupled.search.atlas_search import AtlasSearch
    from lungaccess.problem.peripheral import peripheral_targets
    from lungaccess.problem.target import point_target
    from lungaccess.problem.task import Task

    lung, atlas = _small_atlas()

    def search_for(point: Float) -> AtlasSearch:
        task = Task(lung=lung, system=atlas.system, target=point_target(lung, point))
        return AtlasSearch(task, atlas)

    points = peripheral_targets(lung, (targets + 1) // 2, 0)
    return search_for, np.random.default_rng(0).permutation(points)[:targets]


@cache
def _small_atlas() -> tuple[Lung, Atlas]:
    import lungaccess as la
    from anatomy.build import build_lung
    from anatomy.phantom import make_phantom

    lung = build_lung(make_phantom(seed=PHANTOM_SEED, size="small").images)
    return lung, la.build_atlas(lung, la.load_system("ultrathin"))


def starts(entries: int) -> tuple[Float, Float]:
    """Return positions and directions as a finer atlas of a synthetic lung has them.

    Deployments of an atlas are drawn at random and moved by up to `JITTER_MM` and about `JITTER_RAD`.
    """
    _lung, atlas = _small_atlas()
    rng = np.random.default_rng(0)
    drawn = rng.integers(atlas.deployments.count, size=entries)
    positions = atlas.deployments.positions[drawn] + rng.uniform(-JITTER_MM, JITTER_MM, (entries, 3))
    tangents = atlas.deployments.tangents[drawn] + JITTER_RAD * rng.standard_normal((entries, 3))
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    return positions, tangents


def index_targets() -> Float:
    """Return `(INDEX_TARGETS, 3)` peripheral points of the same lung."""
    from lungaccess.problem.peripheral import peripheral_targets

    return peripheral_targets(_small_atlas()[0], INDEX_TARGETS // 2, 0)


def free_environment() -> NeedleEnvironment:
    """Return an environment without obstacles for the needle of the default system."""
    import lungaccess as la
    from stages.needle.environment import environment_of_labels

    labels = np.zeros((8, 8, 8), dtype=np.uint16, order="F")
    grid = Grid.from_spacing(labels.shape, (BOX_MM / 8,) * 3, (0.0, 0.0, 0.0))
    return environment_of_labels(labels, grid, la.load_system("thin-scope").needle, required_clearance_mm=1.0)


def mechanics(count: int) -> TubeMechanics:
    """Return nested tubes, all of them curved, that never snap; up to five."""
    from stages.tube.device import Tube
    from stages.tube.mechanics import TubeMechanics

    return TubeMechanics(
        [
            Tube(
                outer_diameter_mm=outer, inner_diameter_mm=inner, length_mm=length, curved_length_mm=40.0,
                precurvature_per_mm=0.006,
            )
            for length, (outer, inner) in zip(TUBE_MM[:count], TUBE_DIAMETERS_MM[-count:], strict=True)
        ]
    )  # fmt: skip


def configurations(made: TubeMechanics, count: int, seed: int = 0) -> tuple[Float, Float]:
    """Return base angles and rear ends, drawn at random."""
    rng = np.random.default_rng(seed)
    ahead = np.sort(rng.uniform(10.0, 60.0, (count, made.count)), axis=1)[:, ::-1]
    beta = np.minimum(ahead - made.lengths_mm, 0.0)
    beta = np.minimum.accumulate(beta[:, ::-1], axis=1)[:, ::-1]
    return rng.uniform(-math.pi, math.pi, beta.shape), beta


def random_mechanics(count: int, designs: int, seed: int = 0) -> list[TubeMechanics]:
    """Return nested curved tubes drawn at random, of which some snap.

    The thinnest bore is 0.5 to 1.3 mm, walls 0.08 to 0.25 mm, clearances 0.03 to 0.12 mm; the tubes are 0.3
    to 0.7 m long, and curved by up to 0.015/mm over 15 to 60 mm.
    """
    from stages.tube.device import Tube
    from stages.tube.mechanics import TubeMechanics

    rng = np.random.default_rng(seed)
    made = []
    for _ in range(designs):
        bore, longest, tubes = rng.uniform(0.5, 1.3), rng.uniform(300.0, 700.0), []
        for number in range(count):
            outer = bore + 2.0 * rng.uniform(0.08, 0.25)
            tubes.append(
                Tube(
                    outer_diameter_mm=outer,
                    inner_diameter_mm=bore,
                    length_mm=longest - 60.0 * number,
                    curved_length_mm=rng.uniform(15.0, 60.0),
                    precurvature_per_mm=rng.uniform(0.001, 0.015),
                )
            )
            bore = outer + rng.uniform(0.03, 0.12)
        made.append(TubeMechanics(tubes))
    return made


def tours(lesions: int) -> list[Subtree]:
    """Return the subtrees to random lesions in `TOUR_MODELS` random airways."""
    from experiments.support.tour_models import random_airway, random_lesions
    from stages.scope.tour.subtree import find_exits, subtree_to

    made = []
    for seed in range(TOUR_MODELS):
        tree = random_airway(seed)
        made.append(subtree_to(tree, find_exits(tree, random_lesions(tree, lesions, seed))))
    return made
