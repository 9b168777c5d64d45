"""The commands `lungaccess presets`, `tubes`, `shapes` and `design`: devices without a patient."""

from __future__ import annotations

import math
import tomllib
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter
from rich.table import Table

from lungaccess.cli import lazy, terminal
from lungaccess.cli.commands.exchange import template_text
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.numbers import Angle, NotNegative, Processes
from lungaccess.cli.options import DEFAULT_SYSTEM, require_picture
from lungaccess.cli.progress import progress
from lungaccess.cli.result_folder import claim_folder, keep_earlier
from lungaccess.plans.record import picked


def presets(*, show: str | None = None) -> ExitCode:
    """List the systems that ship with lungaccess, the least invasive first, or print one to start from.

    Its JSON holds every setting.

    Args:
        show: Print the TOML file of this system: edit it, and hand it over with --system FILE.
    """
    if show is not None and not terminal.console.as_json:
        terminal.console.file.write(lazy.preset_text(show))
        return ExitCode.OK
    ordered = [system.name for system in lazy.presets_by_invasiveness()]
    names = (*ordered, *lazy.tube_preset_names(), *lazy.needle_preset_names()) if show is None else (show,)
    systems = {name: lazy.load_system(name) for name in names}
    terminal.tell({name: lazy.to_mapping(system) for name, system in systems.items()})
    rows = [
        (
            name,
            f"{system.scope.outer_diameter_mm:g}",
            " / ".join(f"{tube.outer_diameter_mm:g}" for tube in reversed(system.tubes.nested)),
            *system.needle_sizes,
            system.description,
        )
        for name, system in systems.items()
    ]
    headings = ("name", "scope, mm", "tubes, mm", "needle, mm", "least turning radius, mm", "what it is")
    title = "Systems, the least invasive first (diameters)"
    terminal.console.print(terminal.table(title, headings, rows))
    warned = ((name, each) for name, system in systems.items() for each in lazy.system_warnings(system))
    terminal.show_warnings(f"{name}: {each}" for name, each in warned)
    return ExitCode.OK


def tubes(
    *,
    outer: NotNegative,
    inner: NotNegative,
    system: str = DEFAULT_SYSTEM,
    rotate: Angle = 0.0,
    relative: Angle = 0.0,
    propose: bool = False,
    out: Path = Path("tubes.png"),
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
    require_picture(out)
    answer = lazy.deploy_tubes(
        lazy.load_tubes(system),
        outer,
        inner,
        rotation_rad=math.radians(rotate),
        relative_rad=math.radians(relative),
    )
    _draw(answer, out)
    if terminal.console.as_json:
        terminal.tell(_record(answer, propose))
        return ExitCode.of(answer.acceptable)
    _show_tables(answer, propose)
    terminal.say(f"Written to {out}")
    _show_verdict(answer, propose)
    return ExitCode.of(answer.acceptable)


def _show_verdict(answer: lazy.TubeAnswer, propose: bool) -> None:
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


def _show_tables(answer: lazy.TubeAnswer, propose: bool) -> None:
    terminal.show([terminal.table(f"Tubes of {answer.name}", ("", "", "limit"), _tubes_rows(answer))])
    if not propose:
        return

    comparison = lazy.compare_sequences(answer)
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
    terminal.show([terminal.table("Sequences to the same place", headings, rows)])
    for name, why in comparison.refused.items():
        terminal.say(f"{name}: refused. {why}\n")
    if answer.system is not None:
        terminal.show([_design_table(*lazy.design_choices(answer))])


def _tubes_rows(answer: lazy.TubeAnswer) -> list[terminal.Row]:
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
    return f"{text}  EXCEEDS" if exceeds else text


def _numbers(values: object, digits: int) -> str:
    import numpy as np

    return ", ".join(f"{value + 0.0:.{digits}f}" for value in np.round(np.asarray(values), digits))


def _design_table(present: lazy.DesignProposal, choices: tuple[lazy.DesignProposal, ...]) -> Table:
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
    headings = ("design", "sweep, mm", "aside, mm", "turned, deg", "curve, mm", "1/mm", "wall, mm")
    title = "Designs within the sweep limit, one a length of curve: tip aside and turned, outer wall"
    return terminal.table(title, headings, rows)


def _record(answer: lazy.TubeAnswer, propose: bool) -> dict[str, Any]:
    written = lazy.tubes_record(answer)
    if propose:
        comparison = lazy.compare_sequences(answer)
        written["sequences"] = [
            {"name": each.sequence.name}
            | picked(each, "lateral_sweep_mm follow_the_leader_error_mm least_determinant")
            for each in comparison.deployed
        ]
        written["refused_sequences"] = comparison.refused
        if answer.system is not None:
            written["proposals"] = [
                picked(each, "lateral_sweep_mm tip_offset_mm tip_angle_rad")
                | {name: lazy.to_mapping(getattr(each.tubes, name)) for name in ("outer", "inner")}
                for each in lazy.design_choices(answer)[1]
            ]
    return written


def _draw(answer: lazy.TubeAnswer, out: Path) -> None:
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
    lazy.tubes_png(
        answer.final,
        out,
        deployed=deployed,
        scope_diameter_mm=None if answer.system is None else answer.system.scope.outer_diameter_mm,
        heading=f"{answer.name}: outer tube {answer.outer_mm:g} mm, inner tube {answer.inner_mm:g} mm",
        notes=notes,
    )


def shapes(*, system: str = DEFAULT_SYSTEM, out: Path | None = None) -> ExitCode:
    """Follow a design of one to three tubes through all insertions and relative rotations.

    Exit code 0 if the device allows any deployment; 1 if it allows none.

    Args:
        system: Name of a preset, or path of a TOML file: a system, or one to three tables [[tubes]], the
            innermost first.
        out: CSV file for a table of all shapes.
    """
    device = lazy.load_tubes(system)
    found = lazy.design_shapes(device)
    if out is not None:
        lazy.save_shapes(found, out)
    terminal.tell(lazy.shapes_record(device.name, found))
    terminal.show(
        [terminal.table(f"Shapes of {device.name}", ("", "", "limit"), _shapes_rows(device.name, found))]
    )
    if out is not None:
        terminal.say(f"Written to {out}")
    return ExitCode.of(found.count > 0)


def _shapes_rows(name: str, found: lazy.TubeShapes) -> list[terminal.Row]:
    record = lazy.shapes_record(name, found)
    turns = record["relative_rotations"]
    turned = f"{turns} relative rotations" if turns > 1 else "no relative rotation"
    grid = f"insertions every {record['stop_mm']:g} mm, {turned}"
    rows: list[terminal.Row] = [("deployments looked at", f"{record['candidates']}", grid)]
    rows += [(f"refused: {why}", f"{count}", "") for why, count in record["refused"].items()]
    rows.append(("allowed", f"{record['shapes']}", ""))
    if not found.count:
        return rows
    largest, limits = record["largest"], found.limits
    return [
        *rows,
        ("tip ahead, at most", f"{largest['tip_ahead_mm']:.1f} mm", f"{limits.max_extension_mm:g} mm out"),
        ("tip aside, at most", f"{largest['tip_aside_mm']:.1f} mm", ""),
        ("tip turned, at most", f"{math.degrees(largest['tip_turned_rad']):.1f} deg", ""),
        (
            "largest sideways sweep",
            f"{largest['lateral_sweep_mm']:.3f} mm",
            f"at most {limits.max_lateral_sweep_mm:g} mm",
        ),
        ("follow-the-leader error", f"{largest['follow_the_leader_error_mm']:.3f} mm", ""),
        ("largest strain", f"{100 * largest['strain']:.2f} %", f"at most {100 * limits.max_strain:g} %"),
        ("least determinant on the way", f"{record['least_determinant']:.4f}", "above 0"),
        ("arcs away from the tubes, at most", f"{largest['arc_error_mm']:.4f} mm", ""),
    ]


def design(
    design: Path | None = None,
    *,
    out: Path = Path("lungaccess-design"),
    scheduler: str | None = None,
    workers: Annotated[Processes | None, Parameter(name="--workers")] = None,
) -> ExitCode:
    """Search the numbers of a device that reach most targets of a cohort, or most often succeed there.

    Stop it at any time and start it again: it goes on from what is stored.  Exit code 1 if the best device
    reaches no target.

    Args:
        design: TOML file of the search; that of `lungaccess template design`, on a synthetic patient, if not
            given.
        out: Folder for the runs, the record, the picture and the devices found.
        scheduler: Address of a running dask scheduler, such as tcp://host:8786; this machine if not given.
        workers: How many processes on this machine; as many as it has cores if not given.
    """
    asked = lazy.read_design(design) if design else lazy.design_of(tomllib.loads(template_text("design")))
    claim_folder(out, ())
    with progress(asked.study.name) as shown:
        found = lazy.run_design(asked, out, scheduler=scheduler, workers=workers, progress=shown.step)
    best = found.front[0]
    values = {each.system.name: each.values for each in found.counted}
    lazy.front_png(found.criteria, values, [each.system.name for each in found.front], out / "front.png")
    terminal.tell(found.record())
    _show(asked.study.name, found)
    terminal.console.print(lazy.settings_toml(best.system), soft_wrap=True)
    terminal.say(f"Written to {out}: device.toml, the device above; front/, design.json, front.png")
    return ExitCode.of(any(best.reached))


def _show(title: str, found: lazy.DesignFound) -> None:
    devices = found.record()["devices"]
    first = found.counted[0].system.name
    numbers = {each.system.name: f"{n}" for n, each in enumerate(found.front, start=1)}
    keys = [number.key for number in found.design.vary]
    rows = [
        (
            numbers.get(name, ""),
            name,
            *(_shown(devices[name]["numbers"][key]) for key in keys),
            "{reached} of {targets}".format(**devices[name]),
            *map(_shown, devices[name]["values"].values()),
        )
        for name in dict.fromkeys([first, *numbers])
    ]
    terminal.show_wide([terminal.table(title, ("front", "device", *keys, "reached", *found.criteria), rows)])
    terminal.say(f"{found.tried} devices were tried, {len(found.counted) - 1} of them on all targets.")
    for count, words in found.refused.values():
        terminal.say(f"The validator of devices refused {count}, as here: {words}")


def _shown(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else f"{value}"
