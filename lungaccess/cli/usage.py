"""Words of a command line that make no sense, as an error of the same form as all others."""

import re
from collections.abc import Sequence

from cyclopts import Argument, CycloptsError, exceptions

from anatomy.base.errors import LungaccessError
from lungaccess.cli.examples import EXAMPLES

_GUESS = re.compile(r"\s*(Did you mean [^?]*\?)")
_AVAILABLE = re.compile(r"\s*Available commands: .*", re.DOTALL)
_NOUNS = {int: "a whole number", float: "a number", bool: "true or false"}


class UsageError(LungaccessError):
    """A command or an option is unknown, missing, or has a value that it cannot have."""


def usage_error(error: CycloptsError) -> UsageError:
    """Return what is wrong with the words of a command line, and which words would be right."""
    error.verbose = False
    command = " ".join(error.command_chain or ())
    example = EXAMPLES.get(command)
    found, expected = _found_and_expected(error)
    found = _AVAILABLE.sub("", found)
    guess = _GUESS.search(found)
    explained = (
        f"`lungaccess {command} --help` explains every option; an example: {example}"
        if example
        else f"`{' '.join(('lungaccess', *command.split()))} --help` lists the commands"
    )
    remedy = f"{guess.group(1)} {explained}" if guess else explained
    return UsageError(
        _one_line(_GUESS.sub("", found)), expected=_one_line(expected), remedy=_one_line(remedy)
    )


def _found_and_expected(error: CycloptsError) -> tuple[str, str]:
    """Return what the user wrote, and what could stand there."""
    argument, written = error.argument, str(error)
    if isinstance(error, exceptions.ValidationError) and argument is not None:
        return f"{_name(argument)} is {_value(argument)}", error.exception_message
    if isinstance(error, exceptions.MissingArgumentError) and argument is not None:
        name, what = (error.keyword, "has no value") if error.keyword else (_name(argument), "is missing")
        return f"{name} {what}", argument.parameter.help or f"a value for {_name(argument)}"
    if isinstance(error, exceptions.CoercionError) and error.token is not None:
        name = error.token.keyword or ("A value" if argument is None else _name(argument))
        return f"{name} is {error.token.value!r}. {_guess(written)}", _kind(error)
    if isinstance(error, exceptions.UnknownCommandError):
        return written, "a command of lungaccess"
    if isinstance(error, exceptions.UnknownOptionError):
        return written, "an option of this command"
    if isinstance(error, exceptions.UnusedCliTokensError):
        return f"Words too many: {' '.join(error.unused_tokens or ())}", "no more words than the example has"
    return written, "the words that this command takes"


def _kind(error: exceptions.CoercionError) -> str:
    """Return what a value has to be."""
    choices = re.search(r"Choose from:? (.*?)\.?( Did you mean|$)", str(error), re.DOTALL)
    if choices:
        return f"one of {choices.group(1)}"
    return _NOUNS.get(error.target_type or str, "a value of another kind")


def _guess(text: str) -> str:
    found = _GUESS.search(text)
    return found.group(1) if found else ""


def _value(argument: Argument) -> str:
    return " ".join(token.value for token in argument.tokens)


def _name(argument: Argument) -> str:
    """Return the name of an option as the user wrote it, of a folder or file in capitals."""
    written = [token.keyword for token in argument.tokens if token.keyword]
    if written:
        return str(written[0])
    return argument.name if argument.field_info.is_keyword_only else argument.name.lstrip("-").upper()


def _one_line(text: str) -> str:
    return " ".join(text.split())


def asks_json(words: Sequence[str]) -> bool:
    """Return whether the words of a command line ask for JSON, also where they make no sense otherwise."""
    asked = False
    for word in words:
        if word == "--":
            break
        if word in ("--json", "--json=true", "--no-json"):
            asked = word != "--no-json"
    return asked


def with_nodule_number(words: Sequence[str]) -> list[str]:
    """Let `--nodule` stand alone for `--nodule 0`, the largest; a point may follow it, as in `segment`."""
    completed: list[str] = []
    for word, following in zip(words, [*words[1:], ""], strict=False):
        completed.append(word)
        if word == "--nodule" and not (following.lstrip("+-").isdigit() or ":" in following):
            completed.append("0")
    return completed
