"""The manifest of `synthetic-v1`: the hash of every phantom's masks, and its targets.

A phantom whose masks have another hash is another problem: making it is refused, and so are its scores.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from importlib.resources import files

import numpy as np

from anatomy.base.errors import AnatomyError
from anatomy.base.records import frozen_value
from anatomy.patient import PatientImages
from anatomy.phantom import Phantom, make_phantom
from lungaccess.running.benchmark.synthetic.phantoms import VERSION, BenchmarkPhantom

MANIFEST = "manifest.json"
MASKS = ("lumen", "wall", "vessels", "lung", "fissures")
"""An answer depends on these masks; CT, labels and lobes are for looking at."""
Point = tuple[float, float, float]


@frozen_value
class Entry:
    """What is fixed of one phantom.

    Args:
        masks_sha256: Of grid and masks, see `masks_sha256`.
        targets_lps (tuple of (float, float, float)): LPS mm; target 1 is the first.
    """

    masks_sha256: str
    targets_lps: tuple[Point, ...]


def masks_sha256(images: PatientImages) -> str:
    """Return the SHA-256 (hex) of grid and masks: what is written to files, whatever compresses them."""
    digest = hashlib.sha256()
    # NIfTI keeps the grid in single precision: what was read from files has the hash of what was written.
    grid = np.asarray(images.grid.lps_from_ijk, dtype="<f4") + np.float32(0.0)
    digest.update(json.dumps([list(images.grid.shape), grid.tolist()]).encode())
    for name in MASKS:
        volume = getattr(images, name)
        digest.update(name.encode())
        voxels = np.zeros(0, dtype=np.bool_) if volume is None else np.asarray(volume.array > 0).T
        digest.update(np.packbits(voxels).tobytes())
    return digest.hexdigest()


@cache
def entries() -> Mapping[str, Entry]:
    """Return the manifest by the names of the phantoms."""
    content = json.loads(files(__package__).joinpath(MANIFEST).read_text(encoding="utf-8"))
    return {
        name: Entry(
            masks_sha256=entry["masks_sha256"],
            targets_lps=tuple((float(x), float(y), float(z)) for x, y, z in entry["targets_lps"]),
        )
        for name, entry in content["phantoms"].items()
    }


@cache
def manifest_sha256() -> str:
    """Return the SHA-256 (hex) of the manifest: the benchmark in one number."""
    return hashlib.sha256(files(__package__).joinpath(MANIFEST).read_bytes()).hexdigest()


def unproved_phantom(case: BenchmarkPhantom) -> Phantom:
    """Make a phantom, whether or not it is that of the manifest."""
    made = make_phantom(
        seed=case.seed, size=case.size, spacing_mm=case.spacing_mm, traits=case.traits, precise=True
    )
    return replace(made, images=replace(made.images, name=case.name))


def make_benchmark_phantom(case: BenchmarkPhantom) -> Phantom:
    """Make a phantom of the benchmark.

    Raises:
        AnatomyError: If its masks are not those of the manifest: the generator, or a library below it, has
            changed.
    """
    made = unproved_phantom(case)
    wanted, found = entries()[case.name].masks_sha256, masks_sha256(made.images)
    if found != wanted:
        raise AnatomyError(
            f"The masks of {case.name} made here have the hash {found[:16]}",
            expected=f"{wanted[:16]}, as the manifest of {VERSION} says",
            remedy="Install the versions that constraints.txt names; a changed generator needs a new version",
        )
    return made
