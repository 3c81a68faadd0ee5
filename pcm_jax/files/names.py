"""Names of robots: by the files that hold them, and as candidates call them."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Int

from pcm_jax.errors import InputError
from pcm_jax.graph.validation import Fault

COMPRESSED = (".gz", ".xz")
_NUMBER = re.compile(r"(\d+)\D*$")


def stem_of(path: str) -> str:
    """A file's name without its suffixes: "run1" of "maps/run1.g2o.xz"."""
    target = Path(path)
    bare = target.with_suffix("") if target.suffix in COMPRESSED else target
    name = bare.stem if bare.suffix[1:].isalnum() else bare.name
    return "".join(letter for letter in name if letter.isprintable()).strip() or "robot"


def stems_of(paths: Sequence[str]) -> list[str]:
    """A name for each file: its stem, with its folder's name before it where stems are equal."""
    stems = [stem_of(path) for path in paths]
    return [
        f"{Path(path).absolute().parent.name}-{stem}" if stems.count(stem) > 1 else stem
        for path, stem in zip(paths, stems, strict=True)
    ]


def check_given_once(paths: Sequence[str]) -> None:
    """No file is given twice, under whatever name.

    Raises:
        InputError: naming both.
    """
    seen: dict[tuple[int, int], str] = {}
    for path in paths:
        try:
            status = os.stat(path)  # noqa: PTH116 -- what cannot be a path is reported when read
        except (OSError, ValueError):
            continue
        key = (status.st_dev, status.st_ino)
        if status.st_ino and key in seen:
            again = "" if seen[key] == path else f" (as {seen[key]})"
            raise InputError(f"{path}: given twice{again}, expected every file once")
        seen[key] = path


class Roster:
    """Robots by the ways in which candidates may call them.

    A name is a robot's own. Where it is none, the number in a name will do ("1" for "robot1"), and
    so will a robot's place: its letter (a, b, …) or number (0, 1, …) in the order of the maps.
    Places are no names where some robot is called by another one's place, or where two readings
    differ, as where b is the second robot's letter, but the first one's initial.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self.names = tuple(names)
        self.by_name = {name: index for index, name in enumerate(names)}
        numbers = [found[1] if (found := _NUMBER.search(name)) else "" for name in names]
        distinct = all(numbers) and len(set(map(int, numbers))) == len(numbers)
        self.by_number = {str(int(n)): k for k, n in enumerate(numbers)} if distinct else {}
        self.by_letter = self._by_place([chr(ord("a") + k) for k in range(min(len(names), 26))])
        initials = [name[:1].lower() for name in names]
        self.by_initial = {
            letter: k for k, letter in enumerate(initials) if initials.count(letter) == 1
        }
        self.by_place = self._by_place([str(k) for k in range(len(names))])

    def _by_place(self, places: list[str]) -> dict[str, int]:
        clash = any(self.by_name.get(place, index) != index for index, place in enumerate(places))
        return {} if clash else {place: index for index, place in enumerate(places)}

    def indices(self, values: Sequence[str], fault: Fault) -> Int[np.ndarray, " m"]:
        """The robots' indices `[m]`, −1 where unknown.

        Raises:
            InputError: through `fault`, for a number that may mean two robots.
        """
        different = {value: self._one(value) for value in dict.fromkeys(values)}
        ways = (self.by_number, self.by_place)
        numbers = [value for value in different if value not in self.by_name and value.isdigit()]
        possible = [way for way in ways if way and all(value in way for value in numbers)]
        if numbers and len(possible) == 1:
            different |= {value: {possible[0][value]} for value in numbers}
        for value, found in different.items():
            if len(found) > 1:
                robots = " or ".join(self.names[index] for index in sorted(found))
                raise fault(
                    list(values).index(value),
                    f"robot {value!r} may mean {robots}, expected a robot's name",
                )
        known = {value: found.pop() if found else -1 for value, found in different.items()}
        return np.array([known[value] for value in values], np.int64)

    def _one(self, value: str) -> set[int]:
        if value in self.by_name:
            return {self.by_name[value]}
        if value in self.by_letter:
            return {way[value] for way in (self.by_letter, self.by_initial) if value in way}
        stem = stem_of(value) if "." in value or "/" in value else value
        if stem in self.by_name:
            return {self.by_name[stem]}
        return {way[value] for way in (self.by_number, self.by_place) if value in way}

    def told(self, values: Sequence[str], fault: Fault) -> str:
        """Says who is meant by values that are no robot's own name: "0 is left, 1 is right".

        Raises:
            InputError: as `indices`.
        """
        different = sorted(set(values) - set(self.by_name))
        found = dict(zip(different, self.indices(different, fault).tolist(), strict=True))
        return ", ".join(
            f"{value} is {self.names[index]}" for value, index in found.items() if index >= 0
        )

    def expected(self) -> str:
        """The names to choose from, for messages."""
        return ", ".join(self.by_letter | self.by_name)
