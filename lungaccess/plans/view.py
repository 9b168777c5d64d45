"""What radial ultrasound is expected to show of a nodule, and whether a bronchus leads into it."""

import numpy as np

from anatomy.base.typed import Float
from anatomy.lung import Lung
from anatomy.structures import AIRWAY, LUMEN
from lungaccess.plans.plan import Plan
from lungaccess.plans.tissue import own_nodule

VIEWS = ("absent", "eccentric", "concentric")
"""The views, the worst first: the probe does not see the nodule, lies beside it, or in it."""
RAYS = 72
"""The probe looks all round, every 5 degrees."""
NEAR_MM = np.arange(1.0, 4.01, 0.5)
"""Distances from the probe's axis at which tissue of the nodule is seen: air farther off hides what is behind
it (assumption)."""
ALL_ROUND = 0.95
"""The view is concentric if the nodule is seen in so many of the directions."""
BESIDE_MM = 1.5
"""A bronchus leads into a nodule if lumen or wall of it lies in the nodule or so near to it: the thickness of
the wall of a small bronchus."""


def radial_views(lung: Lung, target_lps: Float, tips: Float) -> list[str]:
    """Return the views of radial ultrasound from tips: "concentric", "eccentric" or "absent".

    Args:
        target_lps ((3,) float64): It lies in a nodule of the mask.
        tips ((N, 9) float64): Points, directions ahead and normals across, LPS mm.
    """
    own, grid = own_nodule(lung, target_lps), lung.grid
    mask = np.zeros(grid.shape, dtype=bool)
    mask[tuple(np.asarray(own).T)] = True
    point, ahead, normal = np.split(np.asarray(tips)[:, None, None], 3, axis=-1)
    angles = 2.0 * np.pi * np.arange(RAYS) / RAYS
    across = np.cos(angles)[:, None, None] * normal + np.sin(angles)[:, None, None] * np.cross(ahead, normal)
    seen = grid.values_at(mask, point + across * NEAR_MM[:, None], False).any(axis=2).mean(axis=1)
    return [VIEWS[int(share > 0.0) + int(share >= ALL_ROUND)] for share in seen.tolist()]


def bronchus_sign(lung: Lung, target_lps: Float) -> str:
    """Say whether a bronchus leads into the nodule in which a target lies; "" where it lies in none."""
    own = own_nodule(lung, target_lps)
    if own is None:
        return ""
    reach = np.ceil(BESIDE_MM / lung.grid.spacing_mm).astype(int) + 1
    low, high = np.maximum(own.min(axis=0) - reach, 0), own.max(axis=0) + reach + 1
    labels = lung.labels[tuple(slice(a, b) for a, b in zip(low, high, strict=True))]
    bronchus = np.argwhere(labels & (AIRWAY | LUMEN))
    if len(bronchus):
        from scipy.spatial import cKDTree

        near, _index = cKDTree((own - low) * lung.grid.spacing_mm).query(
            bronchus * lung.grid.spacing_mm, distance_upper_bound=BESIDE_MM
        )
        if np.isfinite(near).any():
            return "a bronchus leads into the nodule"
    return "no bronchus leads into the nodule"


def view_rows(plan: Plan, lung: Lung) -> list[tuple[str, str]]:
    """Return the expected views from scope and tubes and the bronchus sign, as names and values."""
    target = np.asarray(plan.target_lps)
    sign = bronchus_sign(lung, target)
    if not sign:
        return []
    tips = (plan.scope.lps_from_scope_tip, plan.tube.lps_from_tip)
    scope, tubes = radial_views(lung, target, np.array([tip[:3, [3, 2, 0]].T.ravel() for tip in tips]))
    return [
        ("ultrasound at scope / tubes", f"{scope} / {tubes}"),
        ("bronchus into the nodule", "none" if sign.startswith("no ") else "yes"),
    ]


def view_words(plan: Plan, lung: Lung) -> str:
    """Return `view_rows` in one sentence, "" if nothing is known."""
    return "; ".join(f"{name}: {value}" for name, value in view_rows(plan, lung))


def best_view_words(lung: Lung, target_lps: Float, tips: Float) -> str:
    """Say the best view that is expected from any of the scope's tips `(N, 9)`; "" if not known."""
    sign = bronchus_sign(lung, target_lps)
    if not sign or not len(tips):
        return sign
    best = max(radial_views(lung, target_lps, tips), key=VIEWS.index)
    return f"expected {best} at the best of the scope's tips; {sign}"
