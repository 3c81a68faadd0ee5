"""Results kept on disk as they are done, so that work that was killed goes on where it stopped.

A file is written whole or not at all: under a name that starts with a dot, which readers of the
folder pass over, and then renamed. All that a result depends on is digested into a stamp, and a
result of another stamp is none.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np


def digest(*values: Any, files: Iterable[Path] = ()) -> str:
    """Digests all that results depend on into a stamp.

    Args:
        *values: arrays count by shape, dtype and bytes; anything else by its `repr`.
        files: by their contents; of a folder all Python files, in order.

    Returns:
        24 hexadecimal digits.
    """
    found = hashlib.blake2b(digest_size=12)
    for value in values:
        if hasattr(value, "__array__"):
            array = np.ascontiguousarray(value)
            found.update(repr((array.shape, array.dtype.str)).encode())
            found.update(array.data)
        else:
            found.update(repr(value).encode())
    for file in files:
        for path in sorted(file.rglob("*.py")) if file.is_dir() else [file]:
            found.update(path.read_bytes())
    return found.hexdigest()


@contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """Hands out the name under which a file is to be written, and renames it once it is done."""
    unfinished = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        yield unfinished
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)


def write_json(path: Path, value: Any) -> None:
    """Writes a whole JSON file or none.

    Raises:
        ValueError: NaN or an infinity, which JSON does not have.
    """
    text = json.dumps(value, indent=2, ensure_ascii=False, allow_nan=False)
    with written_whole(path) as unfinished:
        unfinished.write_text(text + "\n")


class Store:
    """Results by name in a folder: each is computed once, and read after that.

        store = Store(folder, digest(options, files=sources))
        result = store("version-3", lambda: {"tpr": 0.97})

    Args:
        folder: where they are kept; made if it is absent. None: nothing is kept.
        stamp: what they depend on, see `digest`. Plain data of another stamp is overwritten; arrays
            of several stamps lie side by side.
    """

    def __init__(self, folder: str | os.PathLike[str] | None, stamp: str):
        self.folder, self.stamp = None if folder is None else Path(folder), stamp
        if self.folder is not None:
            self.folder.mkdir(parents=True, exist_ok=True)

    def __call__(self, name: str, compute: Callable[[], Any]) -> Any:
        """Returns the kept result, plain data; computes and keeps it if there is none."""
        result = self.read(name)
        return self.write(name, compute()) if result is None else result

    def read(self, name: str) -> Any:
        """Returns a result, or None: there is none, it is broken, or its stamp is another."""
        if self.folder is None:
            return None
        try:
            kept = json.loads((self.folder / f"{name}.json").read_text())
            return kept["result"] if kept["stamp"] == self.stamp else None
        except (OSError, ValueError, KeyError, TypeError):
            return None

    def write(self, name: str, result: Any) -> Any:
        """Keeps a result, and returns it as it will be read."""
        if self.folder is None:
            return result
        write_json(self.folder / f"{name}.json", {"stamp": self.stamp, "result": result})
        return self.read(name)

    def read_array(self, name: str) -> np.ndarray | None:
        """Returns an array mapped from its file; None if there is none, or a broken one."""
        if self.folder is None:
            return None
        try:
            return np.load(self._array(self.folder, name), mmap_mode="r")
        except (OSError, EOFError, ValueError):
            return None

    def write_array(self, name: str, array: np.ndarray) -> None:
        """Keeps an array."""
        if self.folder is None:
            return
        path = self._array(self.folder, name)
        with written_whole(path) as unfinished, unfinished.open("wb") as file:
            np.save(file, array)

    def _array(self, folder: Path, name: str) -> Path:
        return folder / f"{self.stamp}-{name}.npy"
