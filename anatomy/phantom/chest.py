"""The shape of a chest: two lungs with lobes, heart, diaphragm, rib cage; smooth functions of position.

All lengths in the code are those of an adult in mm, with the carina at the origin of the LPS frame; a
`Chest` of another size scales them.
"""

import numpy as np

from anatomy.base.records import frozen_value
from anatomy.base.typed import Array
from anatomy.lobes import LEFT_LOWER, LEFT_UPPER, RIGHT_LOWER, RIGHT_MIDDLE, RIGHT_UPPER
from anatomy.lobes import LOBES as NAMED_LOBES

LOBES = {name.removesuffix(" lobe"): number for number, name in NAMED_LOBES.items()}

CAGE_CENTRE_Z = -95.0
"""Height below the carina at which the rib cage is widest."""
DOME_CURVE = 44.0
"""How far a diaphragm falls from its dome to its edge."""
EDGE_ROUNDING_MM = 9.0
"""Lungs have no sharp edges; rounder ones would lose the recesses beside the heart."""
EMPHYSEMA_DEPTH, EMPHYSEMA_DESCENT, EMPHYSEMA_FLATTENING = 0.06, 14.0, 0.4
"""Severe emphysema: a barrel chest and a low, flat diaphragm; within what the imaged box holds."""


def _bump(u: Array, centre: float, width: float) -> Array:
    return np.exp(-(((u - centre) / width) ** 2))


def _smooth_maximum(a: Array, b: Array, width: float) -> Array:
    """Return max(a, b) with the kink rounded over `width`; never below the true maximum."""
    overlap = np.maximum(width - np.abs(a - b), 0)
    return np.asarray(np.maximum(a, b) + overlap * overlap / (4 * width))


def _power(u: Array) -> Array:
    return np.asarray(u * u * np.sqrt(u))


@frozen_value
class Side:
    """One half of the chest; `sign` is +1 for the patient's left, which is +x."""

    sign: float
    half_width: float
    half_depth: float
    height: float
    dome_z: float
    hilum_width: float
    oblique_z: float
    oblique_slope: float
    horizontal_z: float
    wave_phase: float
    dome_curve: float = DOME_CURVE

    def cage(self, x: Array, y: Array, z: Array) -> Array:
        """Return the distance to the inside of the rib cage of this side (negative inside)."""
        dx = np.abs(self.sign * x - (60 - 0.13 * (z - CAGE_CENTRE_Z)))
        dy = np.abs(y - 1)
        dz = np.maximum(z - CAGE_CENTRE_Z, 0)
        terms = _power(dx / self.half_width) + _power(dy / self.half_depth) + (dz / self.height) ** 2
        length = np.sqrt(dx * dx + dy * dy + dz * dz)
        return np.asarray(length - length / (terms + 1e-6) ** 0.4)

    def mediastinum(self, y: Array, z: Array) -> Array:
        """Return the half width of the mediastinum: thin in front, wide at hilum and spine."""
        width = 6 + 15 * _bump(y, 5, 34) + 17 * _bump(y, 66, 27)
        width = width + 12 * _bump(y, 20, 40) / (1 + np.exp((z + 105) / 10))
        if self.sign > 0:
            width = width + 10 * _bump(y, 42, 18) * (1 / (1 + np.exp((z - 25) / 6)))
        return np.asarray(width + self.hilum_width * _bump(y, 7, 26) * _bump(z, -27, 27))

    def diaphragm(self, x: Array, y: Array) -> Array:
        """Return the height z of the diaphragm's dome."""
        r2 = ((self.sign * x - 66) / 78) ** 2 + ((y + 12) / 100) ** 2
        return np.asarray(self.dome_z - self.dome_curve * r2**1.1 - 5 * np.maximum(y, 0) / 60)

    def oblique(self, x: Array, y: Array) -> Array:
        """Return the height z of the oblique fissure, which rises backwards."""
        lateral = self.sign * x - 60
        wave = 3.0 * np.sin(y / 23 + self.wave_phase) + 2.0 * np.sin(lateral / 19 - self.wave_phase)
        return np.asarray(self.oblique_z + self.oblique_slope * y - 0.0016 * lateral**2 + wave)

    def horizontal(self, x: Array, y: Array) -> Array:
        """Return the height z of the horizontal fissure, which exists on the right."""
        lateral = self.sign * x - 60
        wave = 2.0 * np.sin(lateral / 21 + self.wave_phase) + 1.5 * np.sin(y / 26)
        return np.asarray(self.horizontal_z - 0.1 * lateral - 0.0022 * (y + 35) ** 2 + wave)


@frozen_value
class Chest:
    """A chest of `scale` times adult size.

    Every method takes LPS mm arrays x, y, z that broadcast together.  `fills` are the number of a lobe that
    was resected and of the one in its place; (0, 0) where none was.
    """

    scale: float
    right: Side
    left: Side
    heart_centre: tuple[float, float, float]
    heart_radii: tuple[float, float, float]
    fills: tuple[int, int] = (0, 0)

    @property
    def sides(self) -> tuple[Side, Side]:
        """The right and the left half."""
        return self.right, self.left

    def heart(self, x: Array, y: Array, z: Array) -> Array:
        """Return the distance to the heart, an ellipsoid, along rays from its centre, mm; negative inside."""
        s, radii = self.scale, self.heart_radii
        dx, dy, dz = (a / s - centre for a, centre in zip((x, y, z), self.heart_centre, strict=True))
        rho = np.sqrt((dx / radii[0]) ** 2 + (dy / radii[1]) ** 2 + (dz / radii[2]) ** 2) + 1e-6
        length = np.sqrt(dx * dx + dy * dy + dz * dz)
        return np.asarray(s * (length - length / rho))

    def lung(self, side: Side, x: Array, y: Array, z: Array) -> Array:
        """Return the approximate distance to the pleura of one lung in mm (negative inside)."""
        s = self.scale
        heart = 4 - self.heart(x, y, z) / s
        x, y, z = x / s, y / s, z / s
        medial = 0.9 * (side.mediastinum(y, z) - side.sign * x)
        level = _smooth_maximum(side.cage(x, y, z), medial, EDGE_ROUNDING_MM)
        level = _smooth_maximum(level, heart, EDGE_ROUNDING_MM)
        level = _smooth_maximum(level, 0.75 * (side.diaphragm(x, y) - z), 0.5 * EDGE_ROUNDING_MM)
        return np.asarray(s * level)

    def lobe(self, side: Side, x: Array, y: Array, z: Array) -> Array:
        """Return the number of the lobe (1 to 5) that a position in this lung belongs to."""
        x, y, z = x / self.scale, y / self.scale, z / self.scale
        if side.sign > 0:
            found = np.where(z < side.oblique(x, y), np.uint8(LEFT_LOWER), np.uint8(LEFT_UPPER))
        else:
            upper = np.where(z < side.horizontal(x, y), np.uint8(RIGHT_MIDDLE), np.uint8(RIGHT_UPPER))
            found = np.where(z < side.oblique(x, y), np.uint8(RIGHT_LOWER), upper)
        resected, into = self.fills
        return np.where(found == resected, np.uint8(into), found) if resected else found

    def bounds(self) -> tuple[Array, Array]:
        """Return the corners `(3,)`, `(3,)` LPS mm of the imaged box."""
        return self.scale * np.array([-160.0, -114.0, -176.0]), self.scale * np.array([160.0, 112.0, 106.0])


def make_chest(
    rng: np.random.Generator, scale: float, *, fills: tuple[int, int] = (0, 0), emphysema: float = 0.0
) -> Chest:
    """Draw a chest: adult proportions with a few per cent of variation.

    `fills` is that of `Chest`; the side of a resected lobe has a raised diaphragm.  `emphysema` from 0 to 1
    deepens the chest and flattens the diaphragm.
    """
    operated = 0.0 if not fills[0] else 1.0 if fills[0] in (LEFT_UPPER, LEFT_LOWER) else -1.0

    def vary(value: float, fraction: float) -> float:
        return value * (1 + fraction * rng.uniform(-1, 1))

    width, depth, height = vary(72, 0.04), vary(89, 0.04), vary(182, 0.03)
    dome = -104 + rng.uniform(-5, 5)

    def side(sign: float) -> Side:
        return Side(
            sign=sign,
            half_width=width - (3 if sign > 0 else 0),
            half_depth=depth * (1 + EMPHYSEMA_DEPTH * emphysema),
            height=height,
            dome_z=dome
            - (8 if sign > 0 else 0)
            - EMPHYSEMA_DESCENT * emphysema
            # After a lobectomy the diaphragm stands higher on that side.
            + (18.0 if sign == operated else 0),
            dome_curve=DOME_CURVE * (1 - EMPHYSEMA_FLATTENING * emphysema),
            hilum_width=10.0 if sign > 0 else 5.0,
            oblique_z=-63 + rng.uniform(-4, 4),
            oblique_slope=vary(1.45, 0.06),
            horizontal_z=-35 + rng.uniform(-3, 3),
            wave_phase=rng.uniform(0, 2 * np.pi),
        )

    return Chest(
        scale=scale,
        right=side(-1.0),
        left=side(1.0),
        heart_centre=(vary(25, 0.1), -28.0, -80 + rng.uniform(-3, 3)),
        heart_radii=(vary(58, 0.05), vary(42, 0.05), vary(49, 0.05)),
    )
