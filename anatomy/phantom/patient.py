"""Make a whole synthetic patient from a seed and a size."""

import hashlib
from collections.abc import Callable, Mapping
from copy import deepcopy
from functools import cached_property
from types import MappingProxyType
from typing import Literal

import numpy as np

from anatomy.base.errors import SettingsError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Array, Float32, Mask, UInt8
from anatomy.grid import Grid, Volume
from anatomy.patient import PatientImages
from anatomy.phantom.branching import Centerlines, centerlines
from anatomy.phantom.chest import make_chest
from anatomy.phantom.plan import PlannedTree, plan_patient
from anatomy.phantom.rasterize import (
    LABELS,
    Canvas,
    draw_ball,
    draw_body,
    draw_bulla,
    draw_tree,
    phantom_grid,
)
from anatomy.phantom.territory import Bulla, Nodule, make_territory
from anatomy.phantom.traits import PLAIN, RESECTED_INTO, Traits

Size = Literal["adult", "small"]
SCALES: Mapping[str, float] = {"adult": 1.0, "small": 0.7}
"""A small patient is a child of about ten years."""
DEFAULT_SPACING_MM: Mapping[str, float] = {"adult": 1.0, "small": 1.25}
"""As a usual reconstruction; coarser for the small patient, which tests are run on."""
FINEST_MM, COARSEST_MM = 0.3, 2.5
"""Each image of finer voxels would take gigabytes; coarser ones cannot hold the bronchi."""
GREATEST_NOISE_HU = 200.0
"""Ten times the noise of a diagnostic CT."""


@frozen_record
class Phantom:
    """A synthetic patient with the truth about it; all volumes lie on one grid, LPS mm.

    Args:
        size: "adult" or "small".
        images: The masks as a segmentation would give them, of kind "phantom".
        render: Makes the CT; `ct` calls it once.
        labels: uint8, one of `LABELS` for every voxel.
        lobes: uint8, 1 to 5 by `LOBES` within the lungs, also where airways and vessels run; 0 elsewhere.
        centerlines: "airway", "artery", "vein": what was drawn, with the radii that were drawn.
        bullae: Empty without emphysema; they are not part of the lung mask.
    """

    seed: int
    size: str
    images: PatientImages
    render: Callable[[], Volume]
    labels: Volume
    lobes: Volume
    nodules: tuple[Nodule, ...]
    centerlines: Mapping[str, Centerlines]
    traits: Traits = PLAIN
    bullae: tuple[Bulla, ...] = ()

    @cached_property
    def ct(self) -> Volume:
        """The CT, int16 in Hounsfield units, rendered when it is first asked for."""
        return self.render()

    @property
    def grid(self) -> Grid:
        """The voxel grid of all volumes."""
        return self.images.grid

    def mask(self, *names: str) -> Mask:
        """Return the voxels `(ni, nj, nk)` that carry one of the named labels."""
        return _carrying(self.labels.array, names)


def make_phantom(
    seed: int = 0,
    spacing_mm: float | None = None,
    size: Size = "adult",
    *,
    noise_hu: float = 18.0,
    traits: Traits = PLAIN,
    precise: bool = False,
) -> Phantom:
    """Make a synthetic patient.

    The same arguments give the same voxels, bit for bit, on the same kind of processor.  +x is the patient's
    left, +y posterior, +z superior; the carina is the origin.

    Args:
        seed: Not negative.
        spacing_mm: Edge of the cubic voxels, 0.3 to 2.5; by default 1 mm for the adult and 1.25 mm for the
            small patient.
        size: "adult", or "small": 0.7 times an adult, about a child of seven.
        noise_hu: Standard deviation of the noise in the CT.
        traits: Build, disease and operation.
        precise: Draw the body in double precision: the last digit, in which kinds of processors differ, then
            decides no voxel.

    Raises:
        SettingsError: If an argument is out of its range.
        AnatomyError: If the lungs of this seed are too narrow for what belongs in them.

    References:
        [Kitaoka1999], [Tawhai2000], [Weibel1963]

    Examples:
        >>> patient = make_phantom(seed=1, size="small")
        >>> patient.images.kind
        'phantom'
    """
    scale, spacing_mm = _require_settings(seed, spacing_mm, size, noise_hu)
    rng = np.random.default_rng(seed)
    scale *= traits.stature
    resected = traits.resected_lobe
    fills = (resected, RESECTED_INTO[resected]) if resected else (0, 0)
    chest = make_chest(rng, scale, fills=fills, emphysema=traits.emphysema)
    plan = plan_patient(make_territory(chest, rng), scale, spacing_mm, rng, traits)
    canvas = draw_body(chest, phantom_grid(chest, spacing_mm), traits.open_fissures, precise=precise)
    for bulla in plan.bullae:
        draw_bulla(canvas, bulla.centre_lps, bulla.radius_mm)
    for nodule in plan.nodules:
        draw_ball(canvas, nodule.centre_lps, nodule.radius_mm)
    lines, base = {}, 0
    hilar = np.zeros(canvas.labels.shape, dtype=np.bool_, order="F")
    from_mm = scale * traits.hilar_vessel_mm
    for kind, tree in (("airway", plan.airways), ("artery", plan.arteries), ("vein", plan.veins)):
        keep = draw_tree(canvas, tree, base, kind)
        lines[kind] = centerlines(tree.sprouts, tree.inner_mm, tree.outer_mm, keep)
        if kind != "airway" and from_mm:
            hilar |= _wide(canvas, tree, base, from_mm)
        base += len(tree.sprouts.parent)
    return Phantom(
        seed=seed,
        size=size,
        images=_images(canvas, f"phantom {size} {seed}", plan.nodules, hilar if from_mm else None),
        # The noise comes last of all draws, and from a copy, so that it is the same whenever it is asked for.
        render=lambda: _simulate_ct(canvas, noise_hu, deepcopy(rng)),
        labels=Volume(grid=canvas.grid, array=canvas.labels),
        lobes=Volume(grid=canvas.grid, array=canvas.lobes),
        centerlines=MappingProxyType(lines),
        nodules=plan.nodules,
        traits=traits,
        bullae=plan.bullae,
    )


def _require_settings(
    seed: object, spacing_mm: float | None, size: str, noise_hu: float
) -> tuple[float, float]:
    if size not in SCALES:
        raise SettingsError(f"The phantom size is {size!r}", expected=f"one of {', '.join(SCALES)}")
    if not isinstance(seed, int | np.integer) or isinstance(seed, bool) or seed < 0:
        raise SettingsError(f"The phantom seed is {seed!r}", expected="a whole number, not negative")
    spacing_mm = DEFAULT_SPACING_MM[size] if spacing_mm is None else float(spacing_mm)
    if not FINEST_MM <= spacing_mm <= COARSEST_MM * SCALES[size]:
        raise SettingsError(
            f"The voxel size of the phantom is {spacing_mm} mm",
            expected=f"{FINEST_MM} to {COARSEST_MM * SCALES[size]:g} mm for the size {size!r}",
            remedy="Coarser voxels cannot hold the bronchi",
        )
    if not 0 <= noise_hu <= GREATEST_NOISE_HU:
        raise SettingsError(f"The noise is {noise_hu} HU", expected=f"0 to {GREATEST_NOISE_HU:g} HU")
    return SCALES[size], spacing_mm


def _wide(canvas: Canvas, tree: PlannedTree, base: int, from_mm: float) -> Mask:
    """Return the voxels of the branches, drawn after `base` others, whose diameter is `from_mm` or more."""
    start = np.concatenate([[0], np.cumsum(tree.sprouts.counts)[:-1]])
    table = np.zeros(base + len(start) + 2, dtype=np.bool_)
    table[base + 1 : -1] = 2.0 * np.maximum.reduceat(tree.outer_mm, start) >= from_mm
    # The last entry stands for nodules, which belong to no branch.
    return np.asarray(table[np.where(canvas.owner < 0, len(table) - 1, canvas.owner)])


def _carrying(labels: UInt8, names: tuple[str, ...]) -> Mask:
    table = np.zeros(256, dtype=np.bool_)
    table[[LABELS[name] for name in names]] = True
    return np.asarray(table[labels])


def _images(canvas: Canvas, name: str, nodules: tuple[Nodule, ...], hilar: Mask | None) -> PatientImages:
    """Return the masks; `hilar` are the voxels of vessels that count as mediastinum, if any do."""

    def labelled(*names: str) -> Volume:
        return Volume(grid=canvas.grid, array=_carrying(canvas.labels, names))

    lung = (canvas.lobes > 0) & (canvas.labels != LABELS["bulla"])
    vessels = labelled("artery", "vein")
    if hilar is not None:
        lung &= ~hilar
        vessels = Volume(grid=canvas.grid, array=vessels.array & lung)
    return PatientImages(
        name=name,
        kind="phantom",
        grid=canvas.grid,
        lumen=labelled("lumen"),
        wall=labelled("wall"),
        vessels=vessels,
        lung=Volume(grid=canvas.grid, array=lung),
        fissures=labelled("fissure"),
        nodules=labelled("nodule"),
        targets_lps=tuple(n.centre_lps for n in nodules),
        breath_hold="inspiration",
        sources={"labels": hashlib.sha256(canvas.labels.T.tobytes()).hexdigest()},
    )


AIR_HU = -1000.0
"""The scale defines air so."""
WALL_HU = 0.0
"""Walls are soft tissue that thin airways share with air."""
SOLID_HU = 40.0
"""Blood without contrast medium, and nodules."""
FISSURE_HU, FISSURE_THICKNESS_MM = -400.0, 0.6
"""A fissure is a double layer of pleura, thinner than a voxel."""
TISSUE_HU = {"background": AIR_HU, "soft_tissue": 20.0, "mediastinum": 30.0, "heart": 40.0, "bone": 420.0}
"""Usual values of these tissues."""
LEAST_HU, GREATEST_HU = -1024, 3071
"""Range of a CT of 12 bits."""


def _simulate_ct(canvas: Canvas, noise_hu: float, rng: np.random.Generator) -> Volume:
    """Return the int16 CT in HU: shares, 0.6 mm point spread, noise; on the back, lung is denser at +y."""
    from scipy.ndimage import gaussian_filter

    image = _materials(canvas)
    # Point spread of a usual reconstruction kernel: about 1.4 mm full width at half maximum.
    sigma = 0.6 / canvas.spacing_mm
    # Passing the transpose keeps the filter's passes along memory; the blur is isotropic.
    gaussian_filter(image.T, sigma, output=image.T, truncate=3.0, mode="nearest")
    image.T[...] += np.float32(noise_hu) * rng.standard_normal(image.T.shape, dtype=np.float32)
    np.rint(image, out=image)
    np.clip(image, LEAST_HU, GREATEST_HU, out=image)
    return Volume(grid=canvas.grid, array=image.astype(np.int16))


def _materials(canvas: Canvas) -> Float32:
    """Mix the HU of what each voxel holds, slab by slab to stay in the cache."""
    shape = canvas.grid.shape
    image = np.zeros(shape, dtype=np.float32, order="F")
    table = np.full(len(LABELS), TISSUE_HU["mediastinum"], dtype=np.float32)
    for name, tissue in TISSUE_HU.items():
        table[LABELS[name]] = tissue
    y = canvas.grid.lps_from_ijk[1, 3] + canvas.spacing_mm * np.arange(shape[1])
    # Lung is denser towards the back of a patient who lies on it: about 70 HU over 200 mm.
    # The lung has this density after breathing in.
    lung = (-860.0 + 0.35 * y).astype(np.float32)[None, :]
    sheet = np.float32(min(1.0, FISSURE_THICKNESS_MM / canvas.spacing_mm))
    for k in range(shape[2]):
        labels = canvas.labels[:, :, k]
        lobes = canvas.lobes[:, :, k] > 0
        value: Array = table[labels]
        inside = np.where(labels == LABELS["fissure"], lung + sheet * (FISSURE_HU - lung), lung)
        # Air with a trace of tissue.
        inside = np.where(labels == LABELS["bulla"], np.float32(-985.0), inside)
        share = canvas.lung_cover[:, :, k] * np.float32(1 / 255)
        value = np.where(lobes, np.float32(TISSUE_HU["mediastinum"]), value)
        value += share * (inside - value)
        value += canvas.solid_cover[:, :, k] * np.float32(1 / 255) * (np.float32(SOLID_HU) - value)
        value += canvas.airway_cover[:, :, k] * np.float32(1 / 255) * (np.float32(WALL_HU) - value)
        value += canvas.lumen_cover[:, :, k] * np.float32(1 / 255) * (np.float32(AIR_HU) - value)
        image[:, :, k] = value
    return image
