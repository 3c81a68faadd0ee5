"""The errors for bad input: one line that says what, where, and what was expected."""

from __future__ import annotations

import math
import numbers
from collections.abc import Sequence
from os import PathLike
from typing import Any


class InputError(ValueError):
    """A bad argument or file: the message is one complete line, fit to be shown to a user."""

    def __init__(self, message: str):
        super().__init__(" ".join(part.strip() for part in message.splitlines()))


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


def check_class(argument: str, value: Any, expected: str, *classes: type[Any]) -> None:
    """Raises `InputError` unless a value is of one of some classes.

    Args:
        argument: its name.
        value: as a user gave it.
        expected: what was expected, in words.
        *classes: to be of.
    """
    if not isinstance(value, classes):
        raise InputError(f"{argument}: {type(value).__name__} given, expected {expected}")


def check_number(
    argument: str,
    value: Any,
    *,
    least: float = -math.inf,
    most: float = math.inf,
    integer: bool = False,
) -> None:
    """Raises `InputError` unless a value is one real number, not NaN, in a range.

    Args:
        argument: its name.
        value: as a user gave it; booleans are no numbers.
        least: the smallest allowed.
        most: the largest allowed.
        integer: whether it must be an integer.
    """
    kind = numbers.Integral if integer else numbers.Real
    what = "an integer" if integer else "a number"
    bounds = [f"at least {least:g}"] * (least != -math.inf) + [f"at most {most:g}"] * (
        most != math.inf
    )
    bound = f" of {' and '.join(bounds)}" if bounds else ""
    number: Any = value if isinstance(value, kind) and not isinstance(value, bool) else math.nan
    if not least <= number <= most:
        shown = value if isinstance(value, numbers.Number) else type(value).__name__
        raise InputError(f"{argument}: {shown} given, expected {what}{bound}")


def check_choice(argument: str, value: Any, allowed: Sequence[Any]) -> None:
    """Raises `InputError` unless a value is one of those allowed: names, or None.

    Args:
        argument: its name.
        value: as a user gave it.
        allowed: the names.
    """
    if not isinstance(value, str | None) or value not in allowed:
        shown = repr(value) if isinstance(value, str | None) else type(value).__name__
        known = ", ".join(map(str, allowed))
        raise InputError(f"{argument}: {shown} given, expected one of {known}")
