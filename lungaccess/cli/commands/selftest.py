"""The command `lungaccess selftest`: every kind of proof computed again, and compared with a truth."""

from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from lungaccess.cli import terminal
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.options import OutputOptions
from lungaccess.cli.progress import progress

if TYPE_CHECKING:
    from lungaccess.judging.selftest import Failure, Outcome


def selftest(
    *, kind: Annotated[tuple[str, ...], Parameter(negative="")] = (), output: OutputOptions = OutputOptions()
) -> ExitCode:
    """Compute proofs of every kind on drawn cases: compiled, in plain Python, and against a truth.

    Exit code 0 if all agree; 1 if a proof disagrees: kind, seed of the case and both numbers are said.

    Args:
        kind: Kinds of proofs, as the table names them; all of them if not given.
    """
    from lungaccess.judging.selftest import self_test

    with progress("proofs") as shown:
        outcomes = self_test(kind, progress=shown.step)
    if output.json:
        terminal.show_json([{**asdict(each), "held": each.held} for each in outcomes])
    else:
        _show(outcomes)
    return ExitCode.of(all(each.held for each in outcomes))


def _show(outcomes: "tuple[Outcome, ...]") -> None:
    rows = [
        (
            each.kind,
            str(each.cases),
            "not compiled" if each.differences is None else _verdict(each.differences),
            _verdict(each.contradictions),
            f"{each.seconds:.1f}",
        )
        for each in outcomes
    ]
    headings = ("kind", "cases", "compiled = Python", "truth held", "seconds")
    terminal.show([terminal.table("Self-test of the proofs", headings, rows)])
    for each in outcomes:
        for failure in (*(each.differences or ()), *each.contradictions):
            terminal.console.print(f"{each.kind}, seed {failure.seed}: {failure.said}", style="bold red")


def _verdict(failures: "tuple[Failure, ...]") -> str:
    return f"NO, in {len(failures)}" if failures else "yes"
