"""The command `lungaccess start-region`: from which poses near its start a needle still arrives."""

from __future__ import annotations

from typing import TYPE_CHECKING

from anatomy.base.words import of_hundred
from lungaccess.cli import terminal
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.numbers import NotNegative, Positive, Samples, SamplesOrNone, Seed
from lungaccess.cli.options import PatientOfPlan, PatientOptions, PlanFile
from lungaccess.cli.progress import progress

if TYPE_CHECKING:
    from rich.table import Table

    from stages.needle import StartRegion


def start_region(
    plan: PlanFile,
    patient: PatientOfPlan,
    *,
    distance: Positive = 5.0,
    tilt: Positive = 15.0,
    poses: Samples = 10_000,
    iterations: SamplesOrNone = 100,
    radius: NotNegative | None = None,
    scope: bool = False,
    seed: Seed = 0,
    output: PatientOptions = PatientOptions(),
) -> ExitCode:
    """Tell from which poses near its start the needle of a stored plan still reaches the target, clear.

    Args:
        distance: Starts are tried up to so many mm away.
        tilt: Starts are tried up to so many degrees tilted.
        poses: About how many starts are tried.
        iterations: Of the search where nothing simpler finds a path; 0 for none.
        radius: How far in mm from the target a path may end, 0 for not at all; by default the radius of the
            goal, as of `risk`.
        scope: Whether poses of the scope's tip are tried as well, which takes some seconds.
        seed: Seed of the search.
    """
    from lungaccess.planning.one_stage import safe_scope_region
    from lungaccess.plans.plan import Plan
    from lungaccess.uncertainty.risk import safe_start_region

    stored = Plan.load(plan)
    lung = output.load(patient)
    with progress("trying start poses"):
        region = safe_start_region(
            stored, lung, radius_mm=radius, offset_mm=distance, tilt_deg=tilt, poses=poses,
            iterations=iterations, seed=seed,
        )  # fmt: skip
    of_scope = None
    if scope:
        with progress("trying poses of the scope"):
            of_scope = safe_scope_region(stored, lung, seed=seed)
    if output.json:
        told = {} if of_scope is None else {"scope": of_scope.record()}
        terminal.show_json({**region.record(), **told})
    else:
        terminal.say(f"{region.words}.")
        if of_scope is not None:
            terminal.say(f"{of_scope.words}.")
        terminal.show([_proved_table(region), _tried_table(region), _counts_table(region)])
    return ExitCode.OK


def _proved_table(region: StartRegion) -> Table:
    import numpy as np

    proved = region.proved
    chosen = sorted({*np.linspace(0, len(proved.offsets_mm) - 1, 6).astype(int).tolist(), proved.best} - {-1})
    rows = [
        (
            f"{proved.offsets_mm[n]:.2f}",
            f"{np.degrees(proved.tilts_rad[n]):.2f}",
            "*" if n == proved.best else "",
        )
        for n in chosen
        if n < len(proved.offsets_mm)
    ]
    return terminal.table(
        "Proved: every start up to both has a clear path; * most of them", ("mm", "degrees", ""), rows
    )


def _tried_table(region: StartRegion) -> Table:
    import numpy as np

    tried, shares = region.tried, region.tried.table()
    steps = np.arange(1, len(shares) + 1) / len(shares)
    headings = ("up to", *(f"{angle:.0f}°" for angle in np.degrees(tried.tilt_rad) * steps))
    rows = [
        (f"{far:.1f} mm", *("–" if np.isnan(share) else of_hundred(share) for share in row))
        for far, row in zip(tried.offset_mm * steps, shares.tolist(), strict=True)
    ]
    return terminal.table("Tried: % of the starts with a clear path, ring by ring", headings, rows)


def _counts_table(region: StartRegion) -> Table:
    rows = [(words, str(count)) for words, count in region.tried.counts.items()]
    return terminal.table(f"{region.tried.kinds.size} starts were tried", ("found", "starts"), rows)
