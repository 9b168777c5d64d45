"""The command `lungaccess check`."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from anatomy.base.errors import SettingsError
from lungaccess.cli import terminal
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.options import ErrorOptions, PatientOfPlan, PatientOptions


def check(
    plan: Path,
    patient: PatientOfPlan,
    *,
    system: str | None = None,
    curve: str | None = None,
    out: Path | None = None,
    errors: ErrorOptions = ErrorOptions(),
    everything: Annotated[bool, Parameter(name="--all", negative="")] = False,
    output: PatientOptions = PatientOptions(),
) -> ExitCode:
    """Check a stored plan by independent code; exit code 0 if it is accepted, 1 if it is refused.

    Args:
        plan: The plan.json to check.
        system: Check against this preset or TOML file instead of the devices stated in the plan.
        curve: Check the plan with a curve that was edited in 3D Slicer, scene.mrml#needle, and say what
            broke.
        out: Where the plan with the edited needle goes if it is accepted.
        everything: List every finding, not only the nearest limits.
    """
    from lungaccess.judging.appraisal import appraise

    if curve is not None:
        if system or errors.errors or errors.procedure:
            raise SettingsError(
                "--curve is asked for with --system, --errors or --procedure",
                expected="an edited curve alone, which is checked with the devices of the plan",
                remedy="Save the plan with --out, and check that",
            )
        return _check_curve(plan, patient, curve, out, output, everything=everything)
    if out is not None:
        raise SettingsError(
            "--out is given without --curve",
            expected="an edited curve",
            remedy="Add --curve scene.mrml#needle",
        )
    from lungaccess.cli.plan_tables import check_tables, show_findings, show_headline
    from lungaccess.plans.plan import Plan
    from lungaccess.problem.system import load_system

    stored, model = Plan.load(plan), errors.given()
    device = None if system is None else load_system(system)
    followed = errors.given_procedure()
    lung = output.load(patient, thick_slices=True)
    appraisal = appraise(stored, lung, errors=model, procedure=followed, system=device)
    if output.json:
        terminal.show_json({**appraisal.to_mapping(), **appraisal.check.to_mapping()})
        return ExitCode.of(appraisal.accepted)
    show_headline(appraisal.headline)
    show_findings(appraisal)
    if everything:
        terminal.show(check_tables(appraisal.check))
    return ExitCode.of(appraisal.accepted)


def _check_curve(
    plan: Path, patient: Path, text: str, out: Path | None, output: PatientOptions, *, everything: bool
) -> ExitCode:
    """Check a plan with an edited curve, and save it if it is accepted."""
    from anatomy.io.markups import parse_reference, read_named_curve
    from lungaccess.cli.plan_tables import check_tables, show_headline
    from lungaccess.judging.appraisal import Headline
    from lungaccess.plans.plan import Plan
    from lungaccess.showing.slicer import check_curve

    saved = parse_reference(text)
    if saved is None:
        raise SettingsError(
            f"--curve is {text!r}",
            expected="a file of 3D Slicer and the name of a curve in it",
            remedy="Write --curve scene.mrml#needle",
        )
    stored, curve = Plan.load(plan), read_named_curve(saved)
    lung = output.load(patient, thick_slices=True)
    edited = check_curve(stored, lung, curve)
    report = edited.report
    if out is not None and report.accepted:
        edited.plan.save(out)
    if output.json:
        terminal.show_json({"device": edited.device, "edited": edited.words, **report.to_mapping()})
        return ExitCode.of(report.accepted)
    terminal.say(edited.words)
    show_headline(Headline.of(report, None))
    for finding in (*report.refusals, *report.unchecked):
        terminal.say(f"{finding}")
    if everything:
        terminal.show(check_tables(report))
    if out is not None and report.accepted:
        terminal.say(f"Written to {out}")
    return ExitCode.of(report.accepted)
