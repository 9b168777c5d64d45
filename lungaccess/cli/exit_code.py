"""How a command ends, for shells and scripts."""

from enum import IntEnum


class ExitCode(IntEnum):
    """The exit codes of every command."""

    OK = 0
    """Done; of a question: yes.  A plan was found and the independent check accepts it."""
    NEGATIVE = 1
    """Of a question: no.  There is no plan, the check refuses it, or not all of what was asked was done."""
    BAD_INPUT = 2
    """The input is bad, and the error says how."""
    CRASHED = 70
    """The program itself is at fault, which answers no question; the number is EX_SOFTWARE of sysexits."""
    INTERRUPTED = 130
    """The user pressed Ctrl-C, for which shells state the same number, or SIGTERM ended the command."""
    PIPE_CLOSED = 141
    """What reads the output, such as `head`, stopped before its end; shells state the same number."""

    @classmethod
    def of(cls, positive: bool) -> "ExitCode":
        """Return `OK` for a positive outcome, `NEGATIVE` for another."""
        return cls.OK if positive else cls.NEGATIVE
