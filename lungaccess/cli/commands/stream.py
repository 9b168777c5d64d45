"""The command `lungaccess stream`: a plan over OpenIGTLink, planned again from what is tracked."""

import contextlib
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter
from rich.table import Table

from lungaccess.cli import terminal
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.numbers import Hertz, Port, Seconds
from lungaccess.cli.options import ErrorOptions, PatientOfPlan, PatientOptions, PlanFile

if TYPE_CHECKING:
    from lungaccess.showing.live import Answer, LiveCounts


def stream(
    plan: PlanFile,
    patient: PatientOfPlan,
    *,
    host: str = "127.0.0.1",
    port: Port = 18944,
    connect: Annotated[bool, Parameter(negative="")] = False,
    rate: Hertz = 20.0,
    loop: Annotated[bool, Parameter(negative="")] = False,
    seconds: Seconds | None = None,
    errors: ErrorOptions = ErrorOptions(),
    output: PatientOptions = PatientOptions(),
) -> ExitCode:
    """Send poses, paths and phases of a plan by OpenIGTLink, and plan again from tracked poses.

    With --procedure the policy of the procedure decides about tracked poses, else the cheapest way is taken.
    A plan that the check refuses is not sent: exit code 1.

    Args:
        host: Address to listen at, or of the server; this machine alone if not given.
        port: Its port; 0 for a free one to listen at, which is printed.
        connect: Connect to a server there, such as PLUS, and do not listen.
        rate: Rounds a second, in each of which all poses are sent, Hz.
        loop: Begin the motion again when it has ended.
        seconds: End after so long; until Ctrl-C if not given.
    """
    from lungaccess.cli.plan_tables import show_headline
    from lungaccess.judging.appraisal import Headline
    from lungaccess.judging.checking import check
    from lungaccess.planning.procedure import Policy
    from lungaccess.plans.plan import Plan
    from lungaccess.showing.live import Link, LiveSession

    stored = Plan.load(plan)
    with Link(host, port, connects=connect) as link:
        lung = output.load(patient)
        stored.require_lung(lung)
        report = check(stored, lung)
        if not report.accepted:
            if output.json:
                terminal.show_json({"accepted": False, **report.to_mapping()})
            else:
                show_headline(Headline.of(report, None))
            return ExitCode.NEGATIVE
        followed = errors.given_procedure()
        session = LiveSession(
            stored, lung, link, rate_hz=rate, loop=loop, on_answer=None if output.json else _say,
            policy=None if followed is None else Policy(stored, lung, errors.load(), followed),
        )  # fmt: skip
        if not output.json:
            done = "Connecting to" if connect else "Listening at"
            terminal.say(f"{done} {host}:{link.port}. Ctrl-C ends.")
        with contextlib.suppress(KeyboardInterrupt):
            session.run(seconds)
        counts = session.counts
    if output.json:
        terminal.show_json(asdict(counts))
    else:
        terminal.show([_table(counts)])
    return ExitCode.OK


def _say(answer: "Answer") -> None:
    terminal.say(f"{answer.name}: {answer.words} ({1e3 * answer.processor_s:.1f} ms)")


def _table(counts: "LiveCounts") -> Table:
    link = counts.link
    rows = [
        ("rounds", f"{counts.ticks}, of which {counts.overrun} took too long"),
        ("planned again", f"{counts.replans} times, {counts.found} with a way"),
        (
            "processor time of one",
            f"median {counts.replan_median_ms:.1f} ms, most {counts.replan_most_ms:.1f} ms",
        ),
        ("poses passed over for newer ones", f"{counts.superseded}"),
        ("messages", f"{link.sent} sent, {link.received} received, {counts.unknown} of no known name"),
        ("connections", f"{link.joined} joined, {link.left} left"),
        *((f"dropped: {reason}", f"{count}") for reason, count in link.dropped.items()),
    ]
    return terminal.table("What was streamed", ("", ""), rows)
