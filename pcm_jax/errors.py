"""The errors for bad input: one line that says what, where, and what was expected."""

from __future__ import annotations

from os import PathLike


class InputError(ValueError):
    """A bad argument or file: the message is one complete line, fit to be shown to a user."""


class FileFormatError(InputError):
    """A file that does not hold what its format requires.

    Args:
        path: the file.
        line: 1-based line number, or None when the fault is not at one line.
        problem: what is wrong and what was expected.
    """

    def __init__(self, path: str | PathLike[str], line: int | None, problem: str):
        where = f"{path}:{line}" if line is not None else f"{path}"
        super().__init__(f"{where}: {problem}")
        self.path = str(path)
        self.line = line


class InputWarning(UserWarning):
    """Input that was accepted after a documented correction."""


class ConvergenceWarning(InputWarning):
    """A solve that stopped before it met a tolerance; its result is where it stopped."""
