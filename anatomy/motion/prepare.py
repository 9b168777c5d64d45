"""From what was read of a patient's breathing to its `Motion`: at places of the masks, on coarse nodes."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy import ndimage

from anatomy.base.errors import AnatomyError, FrameError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Bool, Float, Labels, Mask
from anatomy.base.words import percent
from anatomy.grid import Grid
from anatomy.motion.motion import LEFT, RIGHT, Motion, cell_bounds
from anatomy.motion.plausible import SAMPLE_MM, require_onto_lungs, require_plausible
from anatomy.motion.source import POPULATION_ERROR_MM, MotionSource, shares_of_motion
from anatomy.structures import OUTSIDE

NODE_MM = 5.0
"""Distance of nodes: motion varies over centimetres, and its bounds are tighter the smaller the cells."""
BORDER_MM = 20.0
"""Nodes around the lungs, so that what lies near the pleura has cells on all sides."""
SIDES = {RIGHT: "right", LEFT: "left"}

At = Callable[[Float], Float]


def prepare_motion(source: MotionSource, labels: Labels, grid: Grid, middle_x_mm: float) -> Motion:
    """Bring what was read to the masks, and test it.

    `labels` are those of `anatomy.structures` on `grid`; `middle_x_mm` is x of the carina.  Raises
    AnatomyError if the motion folds tissue, leads to the head on inhalation or the lungs away from the other
    lungs, or too few landmarks lie in a lung, and FrameError if a field does not cover the lungs.
    """
    # Places `(N, 3)` LPS mm spread over the lungs.
    steps = np.maximum(np.rint(SAMPLE_MM / grid.spacing_mm).astype(int), 1)
    inside = np.argwhere((labels[tuple(slice(None, None, n) for n in steps)] & OUTSIDE) == 0)
    places = grid.lps(inside * steps)
    low, high = places.min(axis=0) - BORDER_MM, places.max(axis=0) + BORDER_MM
    nodes_grid = Grid.over(low, high, NODE_MM)
    at = nodes_grid.centres_lps.reshape(-1, 3)
    is_left = places[:, 0] > middle_x_mm
    if not is_left.any() or is_left.all():
        raise AnatomyError(
            "The lungs lie on one side of the carina, so that left and right cannot be told apart",
            expected="a left and a right lung",
            remedy="Leave [motion] out, or segment both lungs",
        )
    lungs = {RIGHT: places[~is_left], LEFT: places[is_left]}
    if source.vectors is not None:
        nodes, figures = _of_field(source, nodes_grid, at, labels, grid, lungs, middle_x_mm)
    elif source.exhale_lps is not None and source.inhale_lps is not None:
        nodes, figures = _of_landmarks(source, nodes_grid, at, labels, grid, middle_x_mm)
    else:
        # Each height of a lung moves to the feet as ten others do.
        nodes, figures = np.zeros((2, *at.shape)), {"residual_mm": POPULATION_ERROR_MM}
        for side, held in lungs.items():
            apex, base = held[:, 2].max(), held[:, 2].min()
            height = (apex - at[:, 2]) / max(apex - base, NODE_MM)
            nodes[side, :, 2] = -float(source.population_motion_mm or 0.0) * shares_of_motion(height)
    motion = Motion(
        grid=nodes_grid,
        nodes=nodes.reshape(2, *nodes_grid.shape, 3),
        middle_x_mm=middle_x_mm,
        masks_phase=source.masks_phase,
        amplitude=source.amplitude,
        hysteresis=source.hysteresis,
        source=source.description,
        warning_only=source.population_motion_mm is not None,
        figures=figures,
    )
    motion = require_plausible(motion, lungs)
    if source.other_lungs is None:
        return motion
    onto = require_onto_lungs(motion, labels, grid, source.other_lungs)
    return replace(motion, figures={**motion.figures, **onto})


def _of_landmarks(
    source: MotionSource, nodes_grid: Grid, at: Float, labels: Labels, grid: Grid, middle_x_mm: float
) -> tuple[Float, dict[str, float]]:
    """Fit each lung's pairs at the masks' phase, where nothing has to be inverted, and continue the fit."""
    exhale, inhale = np.asarray(source.exhale_lps), np.asarray(source.inhale_lps)
    vectors = inhale - exhale
    points = exhale + source.masks_phase * vectors
    is_left = points[:, 0] > middle_x_mm
    fits = {
        side: _fit_landmarks(points[chosen], vectors[chosen], SIDES[side])
        for side, chosen in ((RIGHT, ~is_left), (LEFT, is_left))
    }
    left_out = np.concatenate([fit.left_out_mm for fit in fits.values()])
    figures = {
        "landmark_pairs": float(len(points)),
        "residual_mm": float(np.concatenate([fit.residual_mm for fit in fits.values()]).mean()),
        "left_out_mm": float(left_out.mean()),
        "left_out_95_mm": float(np.percentile(left_out, 95)),
    }
    nodes = np.zeros((2, *at.shape))
    for side, fit in fits.items():
        # A fit is evaluated so many nodes beyond its lung, which is slow; farther out it is continued.
        known = ndimage.binary_dilation(_near_lung(labels, grid, nodes_grid, side, middle_x_mm), iterations=2)
        nodes[side][known.ravel()] = fit.at(at[known.ravel()])
        nodes[side] = continued(nodes[side].reshape(*nodes_grid.shape, 3), known).reshape(-1, 3)
    return nodes, figures


def _of_field(
    source: MotionSource,
    nodes_grid: Grid,
    at: Float,
    labels: Labels,
    grid: Grid,
    lungs: dict[int, Float],
    middle_x_mm: float,
) -> tuple[Float, dict[str, float]]:
    """Bring a field to the masks' phase, and continue that of each lung beyond it."""
    covered = 0.0
    if source.grid is not None:
        covered = float(source.grid.contains(np.concatenate(list(lungs.values()))).mean())
    # Share of the lungs that a field must cover: a field in a wrong frame covers far less.
    if not covered >= 0.99:
        raise FrameError(
            f"The {source.description} covers {percent(covered)} of the lungs",
            expected="a field over both lungs, LPS mm of the masks",
            remedy="Export the field on the whole image; check that it and the masks come from the same one",
        )
    source = _filled(source)
    own, smooth = _field_at(source, 0.0), _field_at(source, NODE_MM)
    d, rest_mm = _at_masks(source, smooth, at)

    def exact_of(places: Float) -> Float:
        return _at_masks(source, own, places)[0]

    nodes = np.zeros((2, *at.shape))
    errors, mended = [], []
    for side, places in lungs.items():
        inside = _near_lung(labels, grid, nodes_grid, side, middle_x_mm)
        whole, share = continued_unfolded(d.reshape(*nodes_grid.shape, 3), inside, NODE_MM)
        mended.append(share)
        nodes[side] = whole.reshape(-1, 3)
        order_one = [
            ndimage.map_coordinates(whole[..., n], nodes_grid.ijk(places).T, order=1) for n in range(3)
        ]
        errors.append(np.linalg.norm(np.stack(order_one, axis=1) - exact_of(places), axis=1))
    error = np.concatenate(errors)
    return nodes, {
        "to_masks_phase_mm": rest_mm,
        "residual_mm": float(error.mean()),
        "residual_95_mm": float(np.percentile(error, 95)),
        "mended_share": max(mended),
        "sliding_at_pleura_mm": _sliding(labels, grid, exact_of),
    }


def _filled(source: MotionSource) -> MotionSource:
    """Return a field whose voxels without a displacement, as outside of a mask, have the nearest one's."""
    vectors = source.vectors
    if vectors is None:
        return source
    empty = ~vectors.any(axis=-1)
    # A larger share of displacements of exactly 0 is not measured but left out.
    if not 0.01 < float(empty.mean()) < 1.0:
        return source
    nearest = ndimage.distance_transform_edt(empty, return_distances=False, return_indices=True)
    return replace(source, vectors=vectors[tuple(nearest)])


def _field_at(source: MotionSource, smooth_mm: float) -> At:
    """Return the field as a function of points; smoothed, so that coarse nodes do not sample its noise."""
    grid, vectors = source.grid, source.vectors
    if grid is None or vectors is None:
        raise ValueError("a displacement field has a grid and vectors")
    sigma = np.maximum(0.5 * smooth_mm / grid.spacing_mm - 0.5, 0.0)
    parts = [
        ndimage.gaussian_filter(vectors[..., n], sigma, mode="nearest") if sigma.any() else vectors[..., n]
        for n in range(3)
    ]

    def at(points: Float) -> Float:
        index = grid.ijk(points).T
        return np.stack([ndimage.map_coordinates(p, index, order=1, mode="nearest") for p in parts], axis=1)

    return at


def _at_masks(source: MotionSource, field: At, places: Float) -> tuple[Float, float]:
    """Return end-exhale to end-inhale displacements at places of the masks, and what is left of the search.

    A point Y of the field is at `Y + share D(Y)` in the masks' phase; Y is found by fixed point.
    """
    backwards = source.maps_from == "end-inhale"
    share = 1.0 - source.masks_phase if backwards else source.masks_phase
    found, rest = places, 0.0
    # The fixed point that brings a field to the masks' phase converges, as a lung's motion contracts.
    for _ in range(60 if share else 0):
        nearer = places - share * field(found)
        rest = float(np.abs(nearer - found).max())
        found = nearer
        if rest < 1e-4:
            break
    d = field(found)
    return (-d if backwards else d), rest


def _near_lung(labels: Labels, grid: Grid, nodes_grid: Grid, side: int, middle_x_mm: float) -> Mask:
    points = nodes_grid.centres_lps
    index = np.rint(grid.ijk(points)).astype(int)
    within = ((index >= 0) & (index < np.asarray(grid.shape))).all(axis=-1)
    held = labels[tuple(np.clip(index, 0, np.asarray(grid.shape) - 1).reshape(-1, 3).T)]
    inside = within & ((held.reshape(within.shape) & OUTSIDE) == 0)
    return np.asarray(inside & ((points[..., 0] > middle_x_mm) == (side == LEFT)))


def _sliding(labels: Labels, grid: Grid, field: At) -> float:
    """Return the mean difference in mm of a field 5 mm inside and 5 mm outside of the pleura."""
    steps = np.maximum(np.rint(SAMPLE_MM / grid.spacing_mm).astype(int), 1)
    inside = (labels[tuple(slice(None, None, n) for n in steps)] & OUTSIDE) == 0
    spacing = steps * grid.spacing_mm
    depth = ndimage.distance_transform_edt(inside, sampling=spacing)
    depth = depth - ndimage.distance_transform_edt(~inside, sampling=spacing)
    normal = np.stack(np.gradient(ndimage.gaussian_filter(depth, 1.0), *spacing), axis=-1)
    at = np.argwhere(np.abs(depth) < 1.5 * float(spacing.max()))[::7]
    n = normal[tuple(at.T)] @ (grid.lps_from_ijk[:3, :3] / grid.spacing_mm).T
    points = grid.lps(at * steps)
    return float(np.linalg.norm(field(points + 5.0 * n) - field(points - 5.0 * n), axis=1).mean())


def continued_unfolded(values: Float, inside: Mask, spacing_mm: float) -> tuple[Float, float]:
    """Return a continuation that mends a field where it slides or folds, and the share of nodes it mends.

    A field of both lungs jumps from one to the other where they touch, and at the pleura; the nodes of cells
    in which it does are continued over, too.  `values` `(ni, nj, nk, 3)` are displacements in mm at nodes
    `spacing_mm` apart, `inside` the nodes in a lung.
    """
    known = inside.copy()
    # Each takes away the nodes of one more layer of such cells.
    for _ in range(3):
        out = continued(values, known)
        bounds = cell_bounds(out, spacing_mm)
        # Tissue that would be squeezed or sheared by half within one cell: a field slides there, or is noise.
        steep = np.pad(np.maximum(-bounds[..., 0], bounds[..., 1]) > 0.5, 1)
        wrong = known & ndimage.maximum_filter(steep, 2)[1:, 1:, 1:]
        if not wrong.any() or wrong.sum() > 0.5 * known.sum():
            break
        known &= ~wrong
    return out, float(1.0 - known.sum() / max(inside.sum(), 1))


def continued(values: Float, known: Mask) -> Float:
    """Return values `(ni, nj, nk, 3)` that equal the given ones at known nodes, and are smooth elsewhere.

    Elsewhere they begin with the value of the nearest known node, and become the mean of their six
    neighbours step by step.
    """
    nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    out = values[tuple(nearest)]
    # Steps that even out what the continuation begins with, over the width of some ten cells.
    for _ in range(60):
        mean = np.zeros_like(out)
        for axis in range(3):
            for by in (1, -1):  # The neighbours of a node at the border are itself there.
                mean += np.take(out, np.arange(out.shape[axis]) + by, axis=axis, mode="clip")
        out = np.where(known[..., None], values, mean / 6.0)
    return np.asarray(out)


SMOOTHINGS = (1e2, 1e3, 1e4, 1e5)
"""From a spline that passes its pairs by a tenth of a mm to one that is nearly affine over a lung."""
LEAST_PAIRS = 20
"""In a lung: twice as many as a quadratic field has coefficients, so that either half determines one."""


@frozen_record
class Fitted:
    """A displacement field of one lung: `(N, 3)` LPS mm to `(N, 3)` mm, and its residuals in mm.

    `residual_mm` `(N,)` is that of the pairs themselves, `left_out_mm` `(N,)` that of each half of the pairs
    as the other half predicts it.
    """

    at: Callable[[Float], Float]
    residual_mm: Float
    left_out_mm: Float


def _fit_landmarks(points: Float, vectors: Float, lung: str) -> Fitted:
    """Fit a thin-plate spline with the smoothness by which each half of the pairs predicts the other.

    Places in the masks `(N, 3)` LPS mm have displacements `(N, 3)` mm; `lung` says whose they are, for
    messages.  Raises AnatomyError if there are too few pairs, or they lie in a plane.
    """
    if len(points) < LEAST_PAIRS:
        raise AnatomyError(
            f"There are {len(points)} pairs of landmarks in the {lung} lung",
            expected=f"at least {LEAST_PAIRS} in each lung, spread over it",
            remedy="Mark more pairs; check that their coordinates are mm of the masks in the frame stated",
        )
    halves = np.arange(len(points)) % 2 == 0
    try:
        errors = [_left_out(points, vectors, halves, smoothing) for smoothing in SMOOTHINGS]
        means = np.array([error.mean() for error in errors])
        # The smoothest spline is taken whose prediction is worse than the best by no more than this factor.
        chosen = int(np.flatnonzero(means <= 1.1 * means.min())[-1])
        at = _spline(points, vectors, SMOOTHINGS[chosen])
        residual = np.linalg.norm(at(points) - vectors, axis=1)
        return Fitted(at=at, residual_mm=residual, left_out_mm=errors[chosen])
    except np.linalg.LinAlgError as error:
        raise AnatomyError(
            f"The landmarks of the {lung} lung determine no field ({error})",
            expected="different points that do not all lie in one plane",
            remedy="Spread the landmarks over the lung, and state each once",
        ) from error


def _left_out(points: Float, vectors: Float, half: Bool, smoothing: float) -> Float:
    """Return the errors `(N,)` of each half as the other predicts it."""
    out = np.zeros(len(points))
    for known in (half, ~half):
        predicted = _spline(points[known], vectors[known], smoothing)(points[~known])
        out[~known] = np.linalg.norm(predicted - vectors[~known], axis=1)
    return out


def _spline(points: Float, vectors: Float, smoothing: float) -> Callable[[Float], Float]:
    from scipy.interpolate import RBFInterpolator

    fitted = RBFInterpolator(points, vectors, kernel="thin_plate_spline", smoothing=smoothing, degree=1)
    return lambda at: np.asarray(fitted(at))
