"""A needle in a plane that turns left or right, steered for the chance of success [Alterovitz2008].

    python -m experiments.alterovitz2008 [--quick]

The needle goes along arcs of one radius, left or right as its bevel lies.  After each insertion its tip is
seen in an image, and it is inserted further or its bevel is turned.  The direction of the tip is deflected by
a normal error in either case, more where the bevel is turned.  Dynamic programming finds the actions of the
greatest chance to reach the target before an obstacle or the border.

The errors, 5 and 20 degrees, and the chance of 72.35 % are the paper's.  Obstacles, target and lengths are
our own, so the two chances cannot be expected to be equal.  What can be compared is the chance that the table
predicts with what simulated insertions count, and with that of the actions that take no errors into account.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import map_coordinates, shift
from scipy.stats import norm

from anatomy.base.records import frozen_value
from anatomy.base.typed import Bool, Float, Int
from experiments.support.results import Result, setting_of, study_parser, write_result

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SIZE_MM, RADIUS_MM, TARGET_MM = 100.0, 50.0, 2.0
OBSTACLES = np.array([[36.0, 42.0, 13.0], [68.0, 40.0, 12.0], [50.0, 71.0, 10.0], [82.0, 72.0, 10.0]])
"""Discs: centre and radius, mm."""
TARGET = np.array([66.0, 88.0])
START = np.array([50.0, 2.0, 0.5 * np.pi])
"""Point in mm and direction of the tip."""
INSERTION_DEG, TURN_DEG = 5.0, 20.0
"""Standard deviations of the direction after an insertion and after the bevel was turned [Alterovitz2008]."""
PUBLISHED = 72.35
STEPS_A_TURN = 128
"""Insertions along a full circle; each is 2.45 mm."""
TURN_PRICE = 1e-3
"""Share of the chance that turning the bevel costs, so that it is not turned for nothing."""
SETTLED, MOST_SWEEPS = 1e-5, 400
MOST_ACTIONS = 400
ALONG = (0.25, 0.5, 0.75, 1.0)
"""Parts of an insertion at which obstacles, border and target are looked at."""
INSERT, TURN = 0, 1


def blocked(points: Float) -> Bool:
    """Tell which points (..., 2) lie in an obstacle or outside the border."""
    off = np.linalg.norm(points[..., None, :] - OBSTACLES[:, :2], axis=-1) <= OBSTACLES[:, 2]
    outside = ((points < 0.0) | (points > SIZE_MM)).any(axis=-1)
    return np.asarray(off.any(axis=-1) | outside)


def reached(points: Float) -> Bool:
    """Tell which points (..., 2) lie in the target."""
    return np.asarray(np.linalg.norm(points - TARGET, axis=-1) <= TARGET_MM)


def along_arc(headings: Float, side: Float, part: float) -> Float:
    """Return how far the tip has moved (..., 2) after a part of an insertion; side is 1 left and -1 right."""
    angle = part * 2.0 * np.pi / STEPS_A_TURN
    ahead, aside = RADIUS_MM * np.sin(angle), side * RADIUS_MM * (1.0 - np.cos(angle))
    c, s = np.cos(headings), np.sin(headings)
    return np.stack([ahead * c - aside * s, ahead * s + aside * c], axis=-1)


@frozen_value
class Table:
    """Chances and actions for each place, direction and side of the bevel.

    Args:
        chances ((2, H, N, N) float64): By side (left, right), direction, x and y.
        actions ((2, H, N, N) int64): INSERT or TURN.
    """

    chances: Float
    actions: Int
    spacing_mm: float

    def at(self, points: Float, headings: Float, sides: Int) -> tuple[Float, Int]:
        """Return chances and actions at points (K, 2); the chance is interpolated in the plane."""
        directions = self.chances.shape[1]
        turned = np.round(headings / (2.0 * np.pi) * directions).astype(int) % directions
        place = points / self.spacing_mm
        near = np.clip(np.round(place).astype(int), 0, self.chances.shape[2] - 1)
        at = np.column_stack([sides, turned, place])
        return (
            map_coordinates(self.chances, at.T, order=1, mode="nearest"),
            self.actions[sides, turned, near[:, 0], near[:, 1]],
        )


def solve(insertion_deg: float, turn_deg: float, spacing_mm: float, directions: int) -> Table:
    """Return the actions of the greatest chance of success, by value iteration.

    Args:
        insertion_deg, turn_deg: Standard deviations of the direction after each action.
        spacing_mm: Of the grid of places.
        directions: A multiple of STEPS_A_TURN.
    """
    headings = 2.0 * np.pi * np.arange(directions) / directions
    axis = np.arange(round(SIZE_MM / spacing_mm) + 1) * spacing_mm
    grid = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1)
    step = directions // STEPS_A_TURN
    moves = [(side, h, turn) for side, turn in enumerate((1.0, -1.0)) for h in range(directions)]
    ends: dict[tuple[int, int], tuple[Float, Bool, Bool]] = {}
    for side, h, turn in moves:
        hit, there = np.zeros(grid.shape[:2], dtype=bool), np.zeros(grid.shape[:2], dtype=bool)
        for part in ALONG:
            points = grid + along_arc(headings[h], np.asarray(turn), part)
            there |= reached(points) & ~hit
            hit |= blocked(points) & ~there
        ends[side, h] = along_arc(headings[h], np.asarray(turn), 1.0) / spacing_mm, hit, there
    values = np.zeros((2, directions, *grid.shape[:2]))
    actions = np.zeros(values.shape, dtype=np.int64)
    spreads = [_spread(insertion_deg, directions), _spread(turn_deg, directions)]
    for _ in range(MOST_SWEEPS):
        inserted, turned = (_expected(values, spread) for spread in spreads)
        turned = (1.0 - TURN_PRICE) * turned[::-1]
        best = np.zeros(values.shape)
        for side, h, turn in moves:
            moved, hit, there = ends[side, h]
            after = inserted[side, (h + round(turn) * step) % directions]
            best[side, h] = np.where(there, 1.0, np.where(hit, 0.0, shift(after, -moved, order=1)))
        actions = np.where(turned > best, TURN, INSERT)
        best = np.maximum(best, turned)
        best[..., blocked(grid)], best[..., reached(grid)] = 0.0, 1.0
        change, values = np.abs(best - values).max(), best
        if change < SETTLED:
            break
    return Table(chances=values, actions=actions, spacing_mm=spacing_mm)


def _spread(sigma_deg: float, directions: int) -> Float:
    """Return the shares (H,) of a normal error of the direction by cells, the first around no error."""
    if sigma_deg == 0.0:
        return np.eye(directions)[0]
    cell = 360.0 / directions
    middle = (np.arange(directions) + directions // 2) % directions - directions // 2
    shares = norm.cdf((middle + 0.5) * cell / sigma_deg) - norm.cdf((middle - 0.5) * cell / sigma_deg)
    return np.asarray(shares / shares.sum())


def _expected(values: Float, spread: Float) -> Float:
    """Return the mean of chances (2, H, N, N) over the errors of the direction."""
    turned = np.fft.rfft(values, axis=1) * np.fft.rfft(spread)[:, None, None]
    return np.asarray(np.fft.irfft(turned, n=values.shape[1], axis=1))


@frozen_value
class Insertions:
    """Simulated insertions: which reach the target, and the ways of the first few."""

    reached: Bool
    ways: tuple[Float, ...]


def simulate(table: Table, count: int, seed: int, *, shown: int = 12) -> Insertions:
    """Carry out the actions of a table with the errors of the paper, from the start."""
    rng = np.random.default_rng(seed)
    points, headings = np.tile(START[:2], (count, 1)), np.full(count, START[2])
    sides, going = np.zeros(count, dtype=np.int64), np.ones(count, dtype=bool)
    sides[:] = best_side(table)
    success = np.zeros(count, dtype=bool)
    ways = [[START[:2]] for _ in range(min(shown, count))]
    for _ in range(MOST_ACTIONS):
        if not going.any():
            break
        action = table.at(points, headings, sides)[1]
        errors = np.radians(np.where(action == INSERT, INSERTION_DEG, TURN_DEG)) * rng.standard_normal(count)
        inserts, turn = going & (action == INSERT), 1.0 - 2.0 * sides
        for part in ALONG:
            passed = points + along_arc(headings, turn, part)
            success |= inserts & going & reached(passed)
            going &= ~(inserts & (blocked(passed) | reached(passed)))
        points = np.where(inserts[:, None], points + along_arc(headings, turn, 1.0), points)
        headings = headings + np.where(inserts, turn * 2.0 * np.pi / STEPS_A_TURN, 0.0) + errors
        sides = np.where(action == TURN, 1 - sides, sides)
        for way, point, moved in zip(ways, points, inserts, strict=False):
            if moved:
                way.append(point)
    return Insertions(reached=success, ways=tuple(np.array(way) for way in ways))


def best_side(table: Table) -> int:
    """Return the side of the bevel with the greater chance at the start."""
    return int(np.argmax(start_chances(table)))


def start_chances(table: Table) -> Float:
    """Return the chance at the start with the bevel to the left and to the right (2,)."""
    return table.at(np.tile(START[:2], (2, 1)), np.full(2, START[2]), np.arange(2))[0]


def draw(tables: dict[str, Table], found: dict[str, Insertions]) -> Figure:
    """Draw the first ways of each table over the chances of the first direction and side."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt
    from matplotlib.patches import Circle

    figure, panels = plt.subplots(1, len(tables), figsize=(4.2 * len(tables), 4.2), squeeze=False)
    for panel, (title, table) in zip(panels[0], tables.items(), strict=True):
        ahead = round(START[2] / (2.0 * np.pi) * table.chances.shape[1])
        chances = table.chances[:, ahead].max(axis=0).T
        panel.imshow(chances, origin="lower", extent=(0, SIZE_MM) * 2, cmap="Blues", vmin=0, vmax=1)
        for x, y, radius in OBSTACLES:
            panel.add_patch(Circle((x, y), radius, color="0.35"))
        panel.add_patch(Circle(tuple(TARGET), TARGET_MM, fill=False, edgecolor="tab:red", linewidth=2))
        for way, good in zip(found[title].ways, found[title].reached, strict=False):
            panel.plot(*way.T, color="tab:green" if good else "tab:orange", linewidth=1)
        panel.set_title(f"{title}: {100 * found[title].reached.mean():.1f} % reach", fontsize=10)
        panel.set(xlabel="mm", xlim=(0, SIZE_MM), ylim=(0, SIZE_MM))
    figure.tight_layout()
    return figure


def main() -> None:
    """Solve, simulate, print, and write the result."""
    options = study_parser(__doc__).parse_args()
    spacing, directions, count = (2.0, 128, 5_000) if options.quick else (0.75, 128, 100_000)
    result = Result(
        name="alterovitz2008", title="A needle in a plane, steered for the chance of success",
        source="Alterovitz, Branicky, Goldberg 2008, figure 9", setting=setting_of(options),
        conditions={
            "plane": f"{SIZE_MM:g} mm square with four discs, target of {TARGET_MM:g} mm radius, needle of "
            f"{RADIUS_MM:g} mm radius: our own",
            "errors": f"direction {INSERTION_DEG:g} degrees after insertions, {TURN_DEG:g} after turns",
            "grid": f"{spacing:g} mm, {directions} directions",
            "simulated": f"{count:,} insertions",
        },
        seeds=[options.seed],
        not_reproduced=["The chance of 72.35 % itself: its obstacles and lengths could not be read."],
    )  # fmt: skip
    tables = {
        "with errors": solve(INSERTION_DEG, TURN_DEG, spacing, directions),
        "without errors": solve(0.0, 0.0, spacing, directions),
    }
    found = {name: simulate(table, count, options.seed) for name, table in tables.items()}
    predicted = 100.0 * float(start_chances(tables["with errors"]).max())
    note = f"the paper's, among its own obstacles: {PUBLISHED} %"
    result.add("chance of success that the table predicts", predicted, unit="%", note=note)
    result.add("share of simulated insertions", 100.0 * float(found["with errors"].reached.mean()), unit="%")
    result.add(
        "the same with actions that take no errors into account",
        100.0 * float(found["without errors"].reached.mean()), unit="%",
    )  # fmt: skip
    result.figure = draw(tables, found)
    print(write_result(result, options.results))


if __name__ == "__main__":
    main()
