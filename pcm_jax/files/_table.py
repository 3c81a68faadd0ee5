"""The lines of several files end to end, with robots and poses in place of the files' own ids."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from pcm_jax.errors import FileFormatError
from pcm_jax.files.pose_file import PoseFile, no_lines
from pcm_jax.files.scopes import Scope
from pcm_jax.files.text import sources
from pcm_jax.graph.loop_closures import find
from pcm_jax.graph.validation import Fault


@dataclasses.dataclass(frozen=True)
class Table:
    """Vertices or edges of all files, in the order of files and lines.

    Attributes:
        robot: int64 `[k, 1]` or `[k, 2]`, −1 for a robot that no file defines.
        ids: int64, likewise: the ids of poses, as their robot's map will have them.
        transforms: jaxlie's parameters `[k, 4]` or `[k, 7]`.
        information: `[k, d, d]`.
        weight: float64 `[k]`.
        label: int64 `[k]`.
        file: int64 `[k]`, index of the file.
        line: int64 `[k]`.
        paths: the files.
    """

    robot: Int[np.ndarray, "k ends"]
    ids: Int[np.ndarray, "k ends"]
    transforms: Float[np.ndarray, "k p"]
    information: Float[np.ndarray, "k d d"]
    weight: Float[np.ndarray, " k"]
    label: Int[np.ndarray, " k"]
    file: Int[np.ndarray, " k"]
    line: Int[np.ndarray, " k"]
    paths: tuple[str, ...]

    def __getitem__(self, rows: np.ndarray) -> Table:
        picked = {
            field.name: getattr(self, field.name)[rows]
            for field in dataclasses.fields(self)
            if field.name != "paths"
        }
        return Table(**picked, paths=self.paths)

    def __len__(self) -> int:
        return len(self.line)

    @property
    def first_path(self) -> str:
        """The file of the first row."""
        return self.paths[self.file[0]]

    @property
    def fault(self) -> Fault:
        """Names a row by its file and line."""
        return lambda row, problem: FileFormatError(
            self.paths[self.file[row]], int(self.line[row]), problem
        )

    @property
    def source(self) -> np.ndarray:
        """Object array `[k]` of strings "file:line"."""
        names = np.empty(len(self), dtype=object)
        for file in np.unique(self.file):
            rows = self.file == file
            names[rows] = sources(self.paths[file], self.line[rows])
        return names


class Placed:
    """The lines of all files, with robots and their poses' ids in place of the files' ids."""

    def __init__(
        self, files: Sequence[PoseFile], scopes: Sequence[Scope], robots: list[str]
    ) -> None:
        self.files, self.scopes = files, scopes
        self.known = [
            np.array([*(robots.index(x) if x in robots else -1 for x in scope.labels), -1])
            for scope in scopes
        ]

    def _locate(self, place: int, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        local, own = self.scopes[place].locate(ids)
        return self.known[place][local], own

    def table(self, kind: str) -> Table:
        """The files' vertices, edges, priors or truth, end to end."""
        ends = 2 if kind == "edges" else 1
        parts = [
            getattr(file, kind) if _has(file, kind) else no_lines(file.group, ends)
            for file in self.files
        ]
        located = [self._locate(place, part.ids) for place, part in enumerate(parts)]
        return Table(
            robot=np.concatenate([robot for robot, _ in located]),
            ids=np.concatenate([ids for _, ids in located]),
            transforms=np.concatenate([part.transforms for part in parts]),
            information=np.concatenate([part.information for part in parts]),
            weight=np.concatenate([part.weight for part in parts]),
            label=np.concatenate([part.label for part in parts]),
            file=np.repeat(np.arange(len(parts)), [len(part) for part in parts]),
            line=np.concatenate([part.line for part in parts]),
            paths=tuple(file.path for file in self.files),
        )

    def stamps(self, robot: int, ids: np.ndarray) -> np.ndarray | None:
        """Seconds of the poses with these ids, NaN where there are none; None without any."""
        out = np.full(len(ids), np.nan)
        for place, file in enumerate(self.files):
            if file.stamps is not None and len(ids):
                whose, own = self._locate(place, file.stamps[0])
                slot, missing = find(ids, own)
                good = ~missing & (whose == robot)
                out[slot[good]] = file.stamps[1][good]
        return None if np.isnan(out).all() else out


def _has(file: PoseFile, kind: str) -> bool:
    """True if a file's lines of this kind count: candidates bring edges only."""
    return getattr(file, kind) is not None and (kind == "edges" or not file.candidates)
