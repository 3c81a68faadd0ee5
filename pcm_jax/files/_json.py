"""JSON of files that are no text of lines: what is where, and errors that say so."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from pcm_jax.errors import FileFormatError
from pcm_jax.files.source import Source
from pcm_jax.graph.validation import LARGEST


class Member:
    """A value in a JSON file, which knows its place for messages.

    Attributes:
        path: the file.
        place: the way to the value, "measurements.a[3]".
        value: what stands there.
    """

    def __init__(self, path: str, place: str, value: Any) -> None:
        self.path, self.place, self.value = path, place, value

    def fault(self, problem: str) -> FileFormatError:
        """An error that names the place."""
        return FileFormatError(self.path, None, f"{self.place or 'the file'}: {problem}")

    def has(self, key: str) -> bool:
        """True if this is an object with a member of that name."""
        return isinstance(self.value, dict) and key in self.value

    def at(self, *keys: str) -> Member:
        """The member of the first of these names that there is.

        Raises:
            FileFormatError: where there is none, or this is no object.
        """
        if not isinstance(self.value, dict):
            raise self.fault(f"{_kind(self.value)} given, expected an object")
        for key in keys:
            if key in self.value:
                return Member(self.path, f"{self.place}.{key}".lstrip("."), self.value[key])
        raise self.fault(f"no {keys[0]!r}, expected one")

    def items(self) -> list[tuple[str, Member]]:
        """The members of an object by name."""
        if not isinstance(self.value, dict):
            raise self.fault(f"{_kind(self.value)} given, expected an object")
        return [(key, self.at(key)) for key in self.value]

    def key(self, name: str) -> Member:
        """A member's name as the number that it is."""
        return Member(self.path, f"{self.place}.{name}", int(name) if name.isdigit() else name)

    def list(self) -> list[Member]:
        """The members of a list."""
        if not isinstance(self.value, list):
            raise self.fault(f"{_kind(self.value)} given, expected a list")
        return [Member(self.path, f"{self.place}[{k}]", one) for k, one in enumerate(self.value)]

    def text(self) -> str:
        """A string."""
        if not isinstance(self.value, str):
            raise self.fault(f"{_kind(self.value)} given, expected text")
        return self.value

    def integer(self) -> int:
        """An integer of 64 bits."""
        if isinstance(self.value, bool) or not isinstance(self.value, int):
            raise self.fault(f"{_kind(self.value)} given, expected an integer")
        if not -(2**63) <= self.value < 2**63:
            raise self.fault(f"{self.value} given, expected an integer of 64 bits")
        return self.value

    def matrix(self, size: int) -> Float[np.ndarray, " n"]:
        """The finite numbers of a square matrix, in one list or a list a row: float64 `[size²]`."""
        values = self.value
        if (
            isinstance(values, list)
            and len(values) == size
            and all(isinstance(row, list) and len(row) == size for row in values)
        ):
            return Member(self.path, self.place, [one for row in values for one in row]).numbers(
                size * size
            )
        return self.numbers(size * size)

    def numbers(self, count: int) -> Float[np.ndarray, " n"]:
        """A list of finite numbers, float64 `[count]`."""
        values = self.value
        if not isinstance(values, list) or len(values) != count or not _numeric(values):
            raise self.fault(f"{_kind(values)} given, expected {count} numbers")
        if not all(abs(one) <= LARGEST for one in values):  # of integers of any length as well
            raise self.fault("a number that is not finite given, expected finite numbers")
        return np.array(values, np.float64)

    def number(self) -> float:
        """A finite number."""
        return float(Member(self.path, self.place, [self.value]).numbers(1)[0])


def _numeric(values: Sequence[Any]) -> bool:
    return all(isinstance(one, int | float) and not isinstance(one, bool) for one in values)


def _kind(value: Any) -> str:
    if isinstance(value, list):
        return f"a list of {len(value)}"
    names = {dict: "an object", str: "text", type(None): "null", bool: "a truth value"}
    return names.get(type(value), repr(value)[:40])


def load(source: Source) -> Member:
    """A whole JSON file.

    Raises:
        FileFormatError: for text that is no JSON, naming the line.
    """
    try:
        return Member(source.path, "", json.loads(source.text))
    except json.JSONDecodeError as error:
        raise FileFormatError(source.path, error.lineno, f"no JSON: {error.msg.lower()}") from None
    except (RecursionError, ValueError) as error:
        raise FileFormatError(source.path, None, f"no JSON: {str(error)[:80]}") from None


def begins_object(source: Source) -> bool:
    """True if the text begins like a JSON object."""
    return bool(source.head) and source.head[0][1].startswith("{")
