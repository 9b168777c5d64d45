"""The command `lungaccess tubes`: one deployment of the tubes, checked against its limits and drawn."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

from lungaccess.cli import terminal
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.numbers import Angle, NotNegative
from lungaccess.cli.options import DEFAULT_SYSTEM, OutputOptions, require_picture
from lungaccess.cli.result_folder import keep_earlier

if TYPE_CHECKING:
    from rich.table import Table

    from lungaccess.planning.one_stage import TubeAnswer
    from stages.tube import DesignProposal, SequenceComparison


def tubes(
    *,
    outer: NotNegative,
    inner: NotNegative,
    system: str = DEFAULT_SYSTEM,
    rotate: Angle = 0.0,
    relative: Angle = 0.0,
    propose: bool = False,
    out: Path = Path("tubes.png"),
    output: OutputOptions = OutputOptions(),
) -> ExitCode:
    """Deploy the tubes alone: tip, stability, sideways motion, picture.

    Exit code 0 if the device allows it; 1 if the tubes would snap or exceed a limit of the system.

    Args:
        outer: How far the outer tube comes out of the scope, mm.
        inner: How far the inner tube comes out of the scope, mm.
        system: Name of a preset, or path of a TOML file: a system, or just two tables [[tubes]], the inner
            one first.
        rotate: Direction of the inner tube's bend about the scope's axis, from +x of its tip, degrees.
        relative: How much farther the base of the outer tube is turned, degrees.
        propose: Compare sequences to the same place, and look for designs that sweep less.
        out: PNG file for the picture.
    """
    from lungaccess.planning.one_stage import deploy_tubes, load_tubes

    require_picture(out)
    answer = deploy_tubes(
        load_tubes(system),
        outer,
        inner,
        rotation_rad=math.radians(rotate),
        relative_rad=math.radians(relative),
    )
    _draw(answer, out)
    if output.json:
        _show_json(answer, propose)
        return ExitCode.of(answer.acceptable)
    _show_tables(answer, propose)
    terminal.say(f"Written to {out}")
    _show_verdict(answer, propose)
    return ExitCode.of(answer.acceptable)


def _show_verdict(answer: TubeAnswer, propose: bool) -> None:
    """Print whether the device allows the deployment, why not, and what to try."""
    if answer.acceptable:
        limits = "" if answer.system is None else " and within the limits of the system"
        terminal.console.print(f"Allowed: stable at every step{limits}.", style="bold green")
        return
    terminal.console.print("Not allowed by this device.", style="bold red")
    for why in answer.refusals:
        terminal.say(f"- {why}.")
    if answer.system is not None and not propose:
        terminal.say("Less of the outer tube sweeps less; --propose compares sequences and other designs.")


def _show_tables(answer: TubeAnswer, propose: bool) -> None:
    terminal.show([terminal.table(f"Tubes of {answer.name}", ("", "", "limit"), _rows(answer))])
    if not propose:
        return
    from lungaccess.planning.one_stage import compare_sequences, design_choices

    comparison = compare_sequences(answer)
    terminal.show([_sequence_table(comparison)])
    for name, why in comparison.refused.items():
        terminal.say(f"{name}: refused. {why}\n")
    if answer.system is not None:
        terminal.show([_design_table(*design_choices(answer))])


def _rows(answer: TubeAnswer) -> list[terminal.Row]:
    limits = None if answer.system is None else answer.system.tubes
    tip, final, deployed = answer.final.base_from_tip, answer.final, answer.deployed
    turned = math.degrees(math.acos(max(-1.0, min(1.0, float(tip[2, 2])))))
    extension = f"at most {limits.max_extension_mm:g} mm" if limits else ""
    too_far = limits is not None and answer.inner_mm > limits.max_extension_mm
    rows = [
        (
            "outer, inner tube out",
            _marked(f"{answer.outer_mm:g} mm, {answer.inner_mm:g} mm", too_far),
            extension,
        ),
        ("tip (x, y, z of the scope tip)", f"{_numbers(tip[:3, 3], 3)} mm", ""),
        ("tip direction", _numbers(tip[:3, 2], 4), ""),
        ("angle between tip and scope", f"{turned:.2f} deg", ""),
        ("stable", "yes" if final.stable else "NO", ""),
        ("least determinant at the end", f"{final.least_determinant:.4f}", "above 0"),
    ]
    if deployed is None:
        snap = answer.snap
        return [*rows, ("deployment", f"SNAPS: {snap.found}" if snap else "", "")]
    sweep = f"at most {limits.max_lateral_sweep_mm:g} mm" if limits else ""
    sweeps = limits is not None and deployed.lateral_sweep_mm > limits.max_lateral_sweep_mm
    return [
        *rows,
        ("least determinant on the way", f"{deployed.least_determinant:.4f}", "above 0"),
        ("largest sideways sweep", _marked(f"{deployed.lateral_sweep_mm:.3f} mm", sweeps), sweep),
        ("follow-the-leader error", f"{deployed.follow_the_leader_error_mm:.3f} mm", ""),
    ]


def _marked(text: str, exceeds: bool) -> str:
    """Return a value with a mark if it exceeds its limit."""
    return f"{text}  EXCEEDS" if exceeds else text


def _numbers(values: object, digits: int) -> str:
    import numpy as np

    return ", ".join(f"{value + 0.0:.{digits}f}" for value in np.round(np.asarray(values), digits))


def _sequence_table(comparison: SequenceComparison) -> Table:
    rows = [
        (
            each.sequence.name,
            f"{each.lateral_sweep_mm:.3f}",
            f"{each.follow_the_leader_error_mm:.3f}",
            f"{each.least_determinant:.3f}",
        )
        for each in comparison.deployed
    ]
    headings = ("sequence", "sweep, mm", "leader error, mm", "least determinant")
    return terminal.table("Sequences to the same place", headings, rows)


def _design_table(present: DesignProposal, choices: tuple[DesignProposal, ...]) -> Table:
    rows = [
        (
            name,
            f"{each.lateral_sweep_mm:.3f}",
            f"{each.tip_offset_mm:.2f}",
            f"{math.degrees(each.tip_angle_rad):.1f}",
            f"{each.tubes.inner.curved_length_mm:.1f}",
            f"{each.tubes.inner.precurvature_per_mm:.4f}",
            f"{0.5 * (each.tubes.outermost.outer_diameter_mm - each.tubes.outermost.inner_diameter_mm):.3f}",
        )
        for name, each in [("present", present), *(("proposal", choice) for choice in choices)]
    ]
    headings = (
        "design", "sweep, mm", "aside, mm", "turned, deg", "curve, mm", "1/mm", "wall, mm",
    )  # fmt: skip
    return terminal.table(
        "Designs within the sweep limit, one a length of curve: tip aside and turned, outer wall",
        headings,
        rows,
    )


def _show_json(answer: TubeAnswer, propose: bool) -> None:
    from lungaccess.planning.one_stage import compare_sequences, design_choices, tubes_record

    written = tubes_record(answer)
    if propose:
        comparison = compare_sequences(answer)
        written["sequences"] = [
            {
                "name": each.sequence.name,
                "lateral_sweep_mm": each.lateral_sweep_mm,
                "follow_the_leader_error_mm": each.follow_the_leader_error_mm,
                "least_determinant": each.least_determinant,
            }
            for each in comparison.deployed
        ]
        written["refused_sequences"] = comparison.refused
        if answer.system is not None:
            written["proposals"] = [_proposal(each) for each in design_choices(answer)[1]]
    terminal.show_json(written)


def _proposal(proposal: DesignProposal) -> dict[str, object]:
    from anatomy.base.settings import to_mapping

    return {
        "lateral_sweep_mm": proposal.lateral_sweep_mm,
        "tip_offset_mm": proposal.tip_offset_mm,
        "tip_angle_rad": proposal.tip_angle_rad,
        "outer": to_mapping(proposal.tubes.outer),
        "inner": to_mapping(proposal.tubes.inner),
    }


def _draw(answer: TubeAnswer, out: Path) -> None:
    from lungaccess.showing.report import tubes_png

    keep_earlier(out)
    deployed = answer.deployed
    notes = [
        f"tip {_numbers(answer.final.base_from_tip[:3, 3], 2)} mm",
        f"{'stable' if answer.final.stable else 'NOT STABLE'}, "
        f"least determinant {answer.final.least_determinant:.3f}",
    ]
    if deployed is not None:
        notes += [
            f"largest sideways sweep {deployed.lateral_sweep_mm:.2f} mm",
            f"follow-the-leader error {deployed.follow_the_leader_error_mm:.2f} mm",
        ]
    if answer.snap is not None:
        out_mm = ", ".join(f"{length:.1f}" for length in reversed(answer.snap.insertions_mm.tolist()))
        notes += ["SNAPS during deployment, at insertions", f"of {out_mm} mm (outer, inner)"]
    tubes_png(
        answer.final,
        out,
        deployed=deployed,
        scope_diameter_mm=None if answer.system is None else answer.system.scope.outer_diameter_mm,
        heading=f"{answer.name}: outer tube {answer.outer_mm:g} mm, inner tube {answer.inner_mm:g} mm",
        notes=notes,
    )
