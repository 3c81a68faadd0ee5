"""An account of what was read and how: `inspect` prints it, and reports carry it."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any

from pcm_jax.files.pose_file import PoseFile
from pcm_jax.files.scopes import Scope


@dataclasses.dataclass(frozen=True)
class FileAccount:
    """An account of how one file was read.

    Attributes:
        path: the file.
        format: the format's name.
        ids: whose its ids are, and by which rule.
        poses: how many it holds.
        edges: how many measurements it holds.
        information: how it was read.
        priors: how many poses it measures by themselves.
        stamps: whether its poses have times.
        left_out: how many lines of each kind were left out.
        notes: what else a user should know.
    """

    path: str
    format: str
    ids: str
    poses: int
    edges: int
    information: str
    priors: int
    stamps: bool
    left_out: Mapping[str, int]
    notes: tuple[str, ...]

    def lines(self) -> Iterator[str]:
        """The account as lines of text."""
        parts = [f"{self.path}: {self.format}, {self.poses} poses, {self.edges} measurements"]
        if self.priors:
            parts.append(f"{self.priors} priors")
        if self.stamps:
            parts.append("times")
        yield ", ".join(parts)
        yield f"  ids: {self.ids}"
        yield f"  information: {self.information}"
        if self.left_out:
            yield f"  {skipped(self.left_out)}"
        yield from (f"  {note}" for note in self.notes)

    def warnings(self) -> Iterator[str]:
        """Lists what a reader of the file must be told, one line each."""
        if self.left_out:
            yield f"{self.path}: {skipped(self.left_out)}"
        yield from (f"{self.path}: {note}" for note in self.notes)


@dataclasses.dataclass(frozen=True)
class Copy:
    """A closure that states an earlier one again.

    Attributes:
        again: its "file:line".
        first: the earlier one's.
        turned: whether it is stated the other way round.
        fresh: whether its file states it for the first time.
    """

    again: str
    first: str
    turned: bool
    fresh: bool

    @property
    def expected(self) -> bool:
        """True if files of several robots hold it by convention: each robot's file, once."""
        return self.fresh and not self.turned

    def __str__(self) -> str:
        return f"{self.again} says what {self.first} says{' the other way round' * self.turned}"


@dataclasses.dataclass(frozen=True)
class Account:
    """An account of how all files were read.

    Attributes:
        files: one account a file.
        copies: closures that state earlier ones again.
        notes: what was left out or decided over all files.
        doubts: information that cannot be meant as it was read, and whether that is sure.
        clipped: how many information matrices were made definite.
    """

    files: tuple[FileAccount, ...]
    copies: tuple[Copy, ...]
    notes: tuple[str, ...]
    doubts: tuple[tuple[str, bool], ...]
    clipped: int

    def warnings(self) -> Iterator[str]:
        """Lists what a reader of files must be told, one line each."""
        for file in self.files:
            yield from file.warnings()
        if self.clipped:
            names = ", ".join(file.path for file in self.files)
            yield f"{names}: {self.clipped} information matrices clipped to positive definite"
        odd = [copy for copy in self.copies if not copy.expected]
        if odd:
            yield (
                f"{len(odd)} closures repeat earlier ones and are counted once (the first:"
                f" {odd[0]})"
            )
        yield from self.notes
        yield from (line for line, severe in self.doubts if severe)

    def as_dict(self) -> dict[str, Any]:
        """The account as JSON has it."""
        return {
            "files": [
                dataclasses.asdict(file) | {"left_out": dict(file.left_out)} for file in self.files
            ],
            "copies": [dataclasses.asdict(copy) for copy in self.copies],
            "notes": list(self.notes),
            "doubts": [line for line, _ in self.doubts],
            "clipped": self.clipped,
        }


def skipped(left_out: Mapping[str, int]) -> str:
    """Lines left out, counted by kind."""
    counts = ", ".join(f"{count} {kind}" for kind, count in left_out.items())
    return f"skipped {sum(left_out.values())} lines ({counts})"


def account_of(file: PoseFile, scope: Scope | None, who: str = "") -> FileAccount:
    """The account of one file; `who` says which robots its candidates mean."""
    rule = scope.rule if scope is not None else "robots by name, candidates only"
    rule += f" ({who})" if who else ""
    if file.candidates and scope is not None:
        rule += "; it defines no robot: its edges are candidates"
    return FileAccount(
        path=file.path,
        format=file.format,
        ids=rule,
        poses=len(file.vertices),
        edges=len(file.edges),
        information=file.how,
        priors=0 if file.priors is None else len(file.priors),
        stamps=file.stamps is not None,
        left_out=dict(file.left_out),
        notes=tuple(file.notes),
    )
