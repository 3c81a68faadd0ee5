"""Robots and their poses' ids, of a file's own ids."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Int

from pcm_jax.graph import symbols


@dataclasses.dataclass(frozen=True)
class Scope:
    """Turns a file's ids into robots and their poses' ids.

    Attributes:
        labels: one per robot the file speaks of, in the robots' order; equal labels in two files
            are one robot.
        names: their names; empty where the file gives none.
        codes: int64, ascending: the symbol letters, labels or ids that `robots` belong to; empty
            for a file of one robot.
        robots: int64, for each of `codes` the index of its robot.
        ids: int64, for each of `codes` of a table the pose's id.
        indexed: bool per robot, whether its poses' ids are the keys' indices.
        kind: "one", "letters", "labels" or "table": what `codes` are.
        rule: how this was decided, one line.
    """

    labels: tuple[str, ...]
    names: tuple[str, ...]
    codes: Int[np.ndarray, " c"]
    robots: Int[np.ndarray, " c"]
    ids: Int[np.ndarray, " c"]
    indexed: Bool[np.ndarray, " r"]
    kind: str
    rule: str

    def locate(self, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Robots (indices of `labels`, −1 where unknown) and their poses' ids, of a file's ids."""
        if self.kind == "one":
            return np.zeros(ids.shape, np.int64), ids
        if not len(self.codes):
            return np.full(ids.shape, -1), ids
        codes = {"letters": symbols.letters_of, "labels": symbols.labels_of}
        wanted = codes[self.kind](ids) if self.kind in codes else ids
        slot = np.minimum(np.searchsorted(self.codes, wanted), len(self.codes) - 1)
        robot = np.where(self.codes[slot] == wanted, self.robots[slot], -1)
        if self.kind == "table":
            return robot, np.where(robot >= 0, self.ids[slot], ids)
        return robot, np.where(self.indexed[robot], symbols.indices_of(ids), ids)


def made_scope(
    labels: Sequence[str],
    names: Sequence[str],
    *,
    kind: str,
    rule: str,
    codes: Sequence[int] | np.ndarray = (),
    robots: Sequence[int] | np.ndarray = (),
    ids: Sequence[int] | np.ndarray = (),
    indexed: Sequence[bool] = (),
) -> Scope:
    """A scope from lists; see `Scope`."""
    flags = np.asarray(indexed, bool) if len(indexed) else np.zeros(len(labels), bool)
    return Scope(
        tuple(labels),
        tuple(names),
        np.asarray(codes, np.int64),
        np.asarray(robots, np.int64),
        np.asarray(ids, np.int64),
        flags,
        kind,
        rule,
    )
