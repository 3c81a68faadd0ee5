"""Results kept on disk as they are done, so that work that was killed goes on where it stopped.

A file is written whole or not at all: under a name that starts with a dot, which readers of the
folder pass over, and then renamed. All that a result depends on is digested into a stamp, and a
result of another stamp is none; so is one whose own digest is not what it says.
"""

from __future__ import annotations

import ctypes
import errno
import hashlib
import io
import json
import os
import secrets
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

ON_LINUX = sys.platform == "linux"
AT_CWD, RENAME_EXCHANGE = -100, 2  # of linux/fcntl.h and linux/fs.h
TRAILER = 16  # bytes after an array: the digest of those before


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


def apart(path: str | os.PathLike[str]) -> tuple[Path, Path]:
    """Gives what a path leads to, and a name beside it for what is not finished, nobody else's."""
    target = Path(os.path.realpath(path))
    return target, target.with_name(f".{target.name[:100]}.{secrets.token_hex(8)}")


def exchange(one: Path, other: Path) -> None:
    """Gives two files or folders each the other's name, at once: Linux's `renameat2`.

    Raises:
        OSError: where the system cannot, and both are as they were.
    """
    rename = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None) if ON_LINUX else None
    if rename is None:
        raise OSError(errno.ENOSYS, os.strerror(errno.ENOSYS))
    if rename(AT_CWD, os.fsencode(one), AT_CWD, os.fsencode(other), RENAME_EXCHANGE):
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))


@contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """Hands out the name under which a file is to be written, and renames it once it is done.

    The name is nobody else's. A link at `path` stays, and what it
    leads to is replaced; a file that is there keeps its mode. The new one is on disk before it is
    renamed.
    """
    target, unfinished = apart(path)
    try:
        mode = target.stat().st_mode & 0o7777 if target.exists() else None
        # Nobody reads it before it has the mode of the file that it replaces.
        os.close(os.open(unfinished, os.O_CREAT | os.O_EXCL | os.O_WRONLY, mode or 0o666))
        yield unfinished
        if mode is not None:
            unfinished.chmod(mode)
        with unfinished.open("rb") as file:
            os.fsync(file.fileno())
        unfinished.replace(target)
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


def _digest_of(result: Any) -> str:
    """Digests plain data as JSON has it."""
    return digest(json.dumps(result, sort_keys=True, allow_nan=False))


def _checksum(content: bytes) -> bytes:
    return hashlib.blake2b(content, digest_size=TRAILER).digest()


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
            whole = kept["stamp"] == self.stamp and kept["digest"] == _digest_of(kept["result"])
            return kept["result"] if whole else None
        except (OSError, ValueError, KeyError, TypeError):
            return None

    def write(self, name: str, result: Any) -> Any:
        """Keeps a result, and returns it as it will be read."""
        if self.folder is None:
            return result
        result = json.loads(json.dumps(result, allow_nan=False))
        kept = {"stamp": self.stamp, "digest": _digest_of(result), "result": result}
        write_json(self.folder / f"{name}.json", kept)
        return self.read(name)

    def read_array(self, name: str) -> np.ndarray | None:
        """Returns an array; None if there is none, or one that was changed or cut short."""
        if self.folder is None:
            return None
        try:
            data = self._array(self.folder, name).read_bytes()
            content, trailer = data[:-TRAILER], data[-TRAILER:]
            if _checksum(content) != trailer:
                return None
            return np.load(io.BytesIO(content), allow_pickle=False)
        except (OSError, EOFError, ValueError):
            return None

    def write_array(self, name: str, array: np.ndarray) -> None:
        """Keeps an array."""
        if self.folder is None:
            return
        path = self._array(self.folder, name)
        content = io.BytesIO()
        np.save(content, array, allow_pickle=False)
        with written_whole(path) as unfinished:
            unfinished.write_bytes(content.getvalue() + _checksum(content.getvalue()))

    def _array(self, folder: Path, name: str) -> Path:
        return folder / f"{self.stamp}-{name}.npy"
