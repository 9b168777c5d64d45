"""What a needle does to the tubes that aim it: their shapes before it comes, on its arrival and after it."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.errors import SettingsError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from anatomy.grid import read_only
from anatomy.shafts import second_moment_mm4
from experiments.support.needle_load import kernels as kernel
from stages.tube.device import Tube
from stages.tube.equilibrium import matrices
from stages.tube.mechanics import TubeMechanics

THREADS = 2
"""The kernel runs without the interpreter's lock."""
STOP_MM = 5.0
"""Motion of the needle between two looks at the tubes: shapes change smoothly, and what lies between two
looks is bounded by second differences."""
BEYOND_STOPS = 4
"""Looks after the arrival of a needle with flexible segments, beside those when a border enters the tubes."""


@frozen_record
class NeedleArrivals:
    """What a needle does to M deployments of tubes, whose base at the scope tip is held.

    Frames are those of the tubes' tip in the frame of the front plate, carried along without turning.

    Args:
        before, arrived, after ((M, 4, 4) float64): Tip before the needle comes, when its tip is at that of
            the tubes, and when it is inserted farthest.
        sweep_mm, sweep_after_mm ((M,) float64): Largest distance of a point of the tubes from its place on
            arrival: before that, and after it.
        strain, needle_strain ((M,) float64): Largest of bending, ahead of the scope's tip.
        least_determinant ((M,) float64): See `Equilibrium.determinant`; where it is 0 or less the tubes snap,
            and the rest is not filled.
    """

    before: Float
    arrived: Float
    after: Float
    sweep_mm: Float
    sweep_after_mm: Float
    strain: Float
    needle_strain: Float
    least_determinant: Float

    @property
    def shift_mm(self) -> Float:
        """How far the tip moves until the needle arrives `(M,)`, mm."""
        return np.asarray(np.linalg.norm(self.arrived[:, :3, 3] - self.before[:, :3, 3], axis=1))

    @property
    def turn_rad(self) -> Float:
        """By how much the tip's direction turns until the needle arrives `(M,)`, rad."""
        ahead, was = self.arrived[:, :3, 2], self.before[:, :3, 2]
        return np.asarray(np.arctan2(np.linalg.norm(np.cross(ahead, was), axis=1), (ahead * was).sum(axis=1)))


def needle_arrivals(
    mechanics: TubeMechanics,
    base_angles_rad: ArrayLike,
    beta_mm: ArrayLike,
    needle_out_mm: float,
    *,
    tip_angles_rad: ArrayLike | None = None,
    stop_mm: float = STOP_MM,
) -> NeedleArrivals:
    """Follow deployed tubes while the needle comes through them and goes on into tissue.

    Tissue does not hold the tubes here; see `experiments.support.needle_load.tissue` for what it does.

    Args:
        mechanics: With a needle.
        base_angles_rad, beta_mm ((M, n) float64): Deployments; see `TubeMechanics`.
        needle_out_mm: How far the needle goes beyond the tubes' tip.
        tip_angles_rad ((M, n) float64): Angles at the tubes' own ends before the needle comes, such as those
            of `TubeShapes`; by default they are looked for.
        stop_mm: Motion of the needle between two looks.

    Raises:
        SettingsError: If there is no needle, it is too short, or numbers are missing.
    """
    needle = mechanics.needle
    beta = np.array(beta_mm, dtype=np.float64, ndmin=2)
    base = np.array(base_angles_rad, dtype=np.float64, ndmin=2)
    if needle is None:
        raise SettingsError("There is no needle", expected="`TubeMechanics(tubes, needle=...)`")
    longest = float((beta[:, 0] + mechanics.lengths_mm[0]).max(initial=0.0)) + needle_out_mm
    if not needle_out_mm >= 0.0 or longest > needle.length_mm:
        raise SettingsError(
            f"The needle is {needle.length_mm:g} mm long and goes {needle_out_mm:g} mm beyond the tubes",
            expected=f"0 mm or more, and a needle of at least {longest:g} mm",
        )
    tips = (
        mechanics.batch(base, beta, needle_mm=0.0).tip_angles_rad
        if tip_angles_rad is None
        else tip_angles_rad
    )
    tips = np.array(tips, dtype=np.float64)
    mechanics.check_shifts(beta)
    results = np.zeros((len(beta), kernel.ARRIVAL_COLUMNS))
    bodies = (*mechanics.tubes, needle)
    strained = np.array([float(body.parts.strained_radius_mm.max()) for body in bodies])
    borders = {float(end) for end in needle.parts.end_mm if end < needle_out_mm}
    # A shaft that is alike all along changes nothing once it has arrived.
    between = np.linspace(0.0, needle_out_mm, BEYOND_STOPS + 1)[1:] if borders else [needle_out_mm]
    beyond = np.array(sorted({*borders, *between}))

    def follow(some: slice) -> None:
        deployments = base[some], beta[some]
        kernel.arrive_all(
            mechanics.design, strained, *deployments, stop_mm, beyond, mechanics.step_rad, tips[some],
            results[some],
        )  # fmt: skip

    with ThreadPoolExecutor(THREADS) as pool:
        edges = np.linspace(0, len(beta), THREADS + 1).astype(int)
        list(pool.map(follow, [slice(a, b) for a, b in zip(edges, edges[1:], strict=False)]))
    return NeedleArrivals(
        before=read_only(matrices(results[:, kernel.BEFORE : kernel.ARRIVED])),
        arrived=read_only(matrices(results[:, kernel.ARRIVED : kernel.AFTER])),
        after=read_only(matrices(results[:, kernel.AFTER :])),
        **{
            name: read_only(results[:, column].copy())
            for name, column in (
                ("sweep_mm", kernel.SWEEP), ("sweep_after_mm", kernel.SWEEP_AFTER), ("strain", kernel.STRAIN),
                ("needle_strain", kernel.NEEDLE_STRAIN), ("least_determinant", kernel.LEAST),
            )
        },
    )  # fmt: skip


def bending_section(
    outer_diameter_mm: float,
    channel_diameter_mm: float,
    length_mm: float,
    stiffness_n_mm2: float,
    curvature_per_mm: float,
) -> Tube:
    """Return a scope's bending section as the outermost of nested tubes, whose rear end is the front plate.

    Its precurvature is what the handle gives it while it is empty.  So section, tubes and needle are one
    equilibrium.  In torsion it is as soft as in bending: no measurement is known, and real ones are stiffer.

    Raises:
        SettingsError: If it is no tube.
    """
    area = second_moment_mm4(outer_diameter_mm, channel_diameter_mm)
    return Tube(
        outer_diameter_mm=outer_diameter_mm,
        inner_diameter_mm=channel_diameter_mm,
        length_mm=length_mm,
        curved_length_mm=length_mm if curvature_per_mm > 0.0 else 0.0,
        precurvature_per_mm=curvature_per_mm,
        youngs_modulus_gpa=1e-3 * stiffness_n_mm2 / area,
        poisson_ratio=0.0,
    )
