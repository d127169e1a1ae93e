"""Run the command line to its exit code: report errors on stderr, and write results to stdout."""

from __future__ import annotations

import contextlib
import os
import signal
import sys

import click

from gdtool.core import ending, log
from gdtool.core.errors import GdtoolError, from_exception, from_os_error

BROKEN_PIPE = 141  # the exit code by which a shell reports SIGPIPE


def guarded(group: click.Command) -> None:
    """Run a command and exit with one of the documented codes; only --debug shows tracebacks."""
    undo = ending.listen()
    try:
        sys.exit(_code_of(group))
    finally:
        undo()


def _code_of(group: click.Command) -> int:
    """Run a command; returns its exit code, or the one that stands for the exception that it raised."""
    try:
        # Not group.main(): click would turn a broken pipe into exit code 1.
        with group.make_context("gdtool", sys.argv[1:]) as context:
            code = group.invoke(context)
        sys.stdout.flush()
        code = code if isinstance(code, int) else 0
    except click.exceptions.Exit as error:
        code = error.exit_code
    except click.Abort:
        code = 128 + signal.SIGINT
    except click.ClickException as error:
        code = _report_usage(error)
    except KeyboardInterrupt as error:
        code = 128 + getattr(error, "number", signal.SIGINT)
    except BrokenPipeError:
        code = BROKEN_PIPE
    except Exception as error:
        code = report_exception(error, "gdtool").exit_code if ending.received is None else 0
    if ending.received:  # a library may have turned the signal's exception into another one
        code = 128 + ending.received
        if ending.received == getattr(signal, "SIGXCPU", None):
            log.line("gdtool: the limit of processor time is reached; raise it (ulimit -t)")
    ending.ignore()
    _close_stdout()
    return code


def _report_usage(error: click.ClickException) -> int:
    """Report an error of the command line in one line; without any argument show the help, as click does."""
    if isinstance(error, getattr(click.exceptions, "NoArgsIsHelpError", ())):
        error.show()
        return error.exit_code
    context = getattr(error, "ctx", None)
    command_path = context.command_path if context is not None else "gdtool"
    text = " ".join(error.format_message().split()).rstrip(".")
    log.line(f"{command_path}: {text[:1].lower() + text[1:]}; see {command_path} --help")
    return error.exit_code


def _close_stdout() -> None:
    """Flush stdout; where that fails (a closed pipe, a full disk), keep the interpreter from flushing it again."""
    try:
        sys.stdout.flush()
    except (OSError, ValueError):
        with contextlib.suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def report_exception(error: Exception, subject: object) -> GdtoolError:
    """Report an exception that was raised while working on subject, with its traceback under --debug.

    Returns the error with an exit code that the exception stands for.
    """
    problem = from_exception(error, subject)
    if debugging():
        import traceback

        traceback.print_exception(problem.__cause__ or error)
    report(problem)
    return problem


def debugging() -> bool:
    """Tell whether --debug is among the arguments."""
    return "--debug" in sys.argv


def report(error: GdtoolError) -> None:
    """Write an error as one line to stderr."""
    report_text(str(error).removeprefix("gdtool: "))


def report_text(text: str) -> None:
    """Write a line to stderr, after the name of the program."""
    log.line(f"gdtool: {text}")


def emit(content: bytes) -> None:
    """Write a result to stdout and flush it.

    Raises OutputError where it cannot be written, BrokenPipeError where the reader has closed the pipe.
    """
    try:
        sys.stdout.flush()
        sys.stdout.buffer.write(content)
        sys.stdout.buffer.flush()
    except BrokenPipeError:
        raise
    except OSError as error:
        raise from_os_error(error, "stdout") from None


def exit_code(failed: list[GdtoolError], done: int) -> int:
    """Return 0 where nothing failed, the code that all failures share where nothing was done, else 1."""
    codes = {error.exit_code for error in failed}
    return 0 if not failed else codes.pop() if not done and len(codes) == 1 else 1
