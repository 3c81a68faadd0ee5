"""The folder of Parquet files that a sweep writes, which readers take for one table.

Each file holds some consecutive worlds, named after them, whole or not at all. What all rows depend
on stands in every file, so that rows of two sweeps are never mixed.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Bool

from pcm_jax.errors import InputError
from pcm_jax.store import written_whole

_NAME = re.compile(r"worlds-(\d+)-(\d+)\.parquet")
_ABOUT = b"pcm_jax.sweep"


class SweepFiles:
    """The files of one sweep.

    Args:
        folder: is made if need be.
        about: what rows depend on, as JSON has it.

    Raises:
        InputError: pyarrow is not installed, or the folder holds rows of another sweep.
    """

    def __init__(self, folder: str | os.PathLike[str], about: Mapping[str, Any]):
        self._parquet = _parquet()
        self._folder, self._about = Path(folder), dict(about)
        self._folder.mkdir(parents=True, exist_ok=True)
        for path, _, _ in self._parts():
            self._check(path)

    def done(self, worlds: int) -> Bool[np.ndarray, " worlds"]:
        """Marks those of the first so many worlds that are written."""
        done = np.zeros(worlds, bool)
        for _, start, stop in self._parts():
            done[start:stop] = True
        return done

    def write(self, start: int, stop: int, columns: Mapping[str, np.ndarray]) -> None:
        """Writes the rows of worlds from `start` up to `stop`."""
        import pyarrow as pa

        about = {_ABOUT: json.dumps(self._about).encode()}
        table = pa.table(dict(columns)).replace_schema_metadata(about)
        with written_whole(self._folder / f"worlds-{start:010d}-{stop:010d}.parquet") as unfinished:
            self._parquet.write_table(table, unfinished)

    def _parts(self) -> Iterator[tuple[Path, int, int]]:
        for path in sorted(self._folder.iterdir()):
            if match := _NAME.fullmatch(path.name):
                yield path, int(match[1]), int(match[2])

    def _check(self, path: Path) -> None:
        import pyarrow as pa

        try:
            metadata = self._parquet.read_schema(path).metadata or {}
            found = json.loads(metadata.get(_ABOUT, b"{}"))
        except (pa.ArrowInvalid, ValueError):
            raise InputError(f"{path}: not a file of a sweep; expected none but those") from None
        for name, value in self._about.items():
            if found.get(name) != json.loads(json.dumps(value)):
                raise InputError(
                    f"{path}: rows of another sweep, with {name} {found.get(name)!r}; expected "
                    f"{value!r}, or another folder"
                )


def _parquet() -> ModuleType:
    try:
        import pyarrow.parquet
    except ImportError:
        raise InputError(
            "pyarrow: not installed, but sweeps write Parquet: pip install '.[sweep]'"
        ) from None
    return pyarrow.parquet
