"""Exit codes, and how an expected error becomes one line that a person can act on."""

from __future__ import annotations

import enum
import sys
from typing import NoReturn

from rich.console import Console
from rich.markup import escape

from smsr.benchmark import BenchmarkFailed
from smsr.errors import Cancelled, InputError, InvalidOption, SmsrError, UnknownOption
from smsr_client import ClientError, ServerUnreachable, ServiceError, WrongAddress
from worker.settings import WrongSettings


class ExitCode(enum.IntEnum):
    """What the command's exit status says."""

    OK = 0
    FAILED = 1
    USAGE = 2
    INPUT_REFUSED = 3
    SERVER_UNREACHABLE = 4
    INTERRUPTED = 130


HELP = (
    "Exit status: 0 done, 1 a job or the solver failed, 2 wrong usage or settings, "
    "3 an input was refused, 4 the server cannot be reached, 130 interrupted."
)

EXPECTED = (SmsrError, ClientError, BenchmarkFailed, WrongSettings, OSError)
"""Errors that are told in lines; any other is a mistake of the program and keeps its traceback."""

console = Console(highlight=False)
"""Standard output: results."""

errors = Console(stderr=True, highlight=False)
"""Standard error: progress and errors, so that output can be piped."""


def complain(message: str) -> None:
    """Write one error line to standard error."""
    errors.print(f"[bold red]Error:[/] {escape(message)}", soft_wrap=True)


def code_of(error: Exception) -> ExitCode:
    """Return the exit code of an expected error."""
    match error:
        case Cancelled():
            return ExitCode.INTERRUPTED
        case UnknownOption() | InvalidOption() | WrongAddress() | WrongSettings():
            return ExitCode.USAGE
        case InputError():
            return ExitCode.INPUT_REFUSED
        case ServerUnreachable():
            return ExitCode.SERVER_UNREACHABLE
        case ServiceError() if error.refused_input:
            return ExitCode.INPUT_REFUSED
        case _:
            return ExitCode.FAILED


def message_of(error: Exception) -> str:
    """Return what to tell a person about an expected error."""
    if isinstance(error, OSError):
        where = f"{error.filename}: " if error.filename else ""
        return f"{where}{error.strerror or error}"
    return str(error)


def leave(error: Exception) -> NoReturn:
    """End the process on an expected error."""
    for problem in error.problems if isinstance(error, WrongSettings) else [message_of(error)]:
        complain(problem)
    sys.exit(code_of(error))
