"""Files that are written whole or not at all."""

from __future__ import annotations

import gzip
import lzma
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike
from pathlib import Path

from pcm_jax.errors import FileFormatError, InputError, check_class
from pcm_jax.files._replaced import can_be_exchanged, exchanged
from pcm_jax.store import apart, written_whole


def check_target(path: str | PathLike[str]) -> Path:
    """The path, if a file can be made there.

    Raises:
        FileFormatError: for a folder that does not exist or must not be written to, and for a path
            that is itself a folder.
    """
    target = Path(path)
    if not target.parent.is_dir():
        raise FileFormatError(target, None, f"there is no folder {target.parent} to write to")
    if target.is_dir():
        raise FileFormatError(target, None, "this is a folder, expected a file to write to")
    if not os.access(target if target.exists() else target.parent, os.W_OK):
        raise FileFormatError(target, None, "cannot be written: permission denied")
    return target


@contextmanager
def folder_written_whole(folder: str | PathLike[str]) -> Iterator[Path]:
    """Hands out a folder to write files to, and gives it its name once they are all there.

    Where a folder of that name is there already, it is replaced by the new one at once, so that its
    files are all old or all new; other files in it are kept. It is not where it holds folders, is
    the current one or another user's, where links lie in it under the files' names, or where the
    system cannot: then the finished files are put into it one after another.

    Raises:
        FileFormatError: where the system refuses to make or rename it.
        InputError: as what is done with it, the folder called by its own name.
    """
    target = Path(folder)
    named, unfinished = apart(target)
    beside = not named.is_dir() or can_be_exchanged(named)
    place = unfinished if beside else named / unfinished.name
    try:
        place.mkdir()
        yield place
        ours = sorted(place.iterdir())
        if not named.is_dir():
            place.rename(named)
        elif not (beside and exchanged(place, named)):
            for one in ours:
                write_bytes(target / one.name, one.read_bytes())
    except InputError as error:
        error.args = (str(error).replace(str(place), str(target)),)
        raise
    except OSError as error:
        raise FileFormatError(folder, None, f"cannot be written: {error.strerror}") from None
    finally:
        shutil.rmtree(place, ignore_errors=True)


def write_text(path: str | PathLike[str], text: str) -> None:
    """`write_bytes` of the text in UTF-8, what it lacks escaped; `.gz` and `.xz` compress."""
    check_class("path", path, "a path", str, PathLike)
    write_bytes(path, _compressed(Path(path).suffix, text.encode(errors="backslashreplace")))


def write_bytes(path: str | PathLike[str], data: bytes) -> None:
    """Writes a temporary file beside `path` and moves it there, see `written_whole`.

    Raises:
        FileFormatError: as `check_target`, and where the system refuses.
    """
    try:
        target = check_target(path)
        if target.exists() and not target.is_file():
            target.write_bytes(data)  # a device or pipe must not be replaced by a file
        else:
            with written_whole(target) as unfinished:
                unfinished.write_bytes(data)
    except OSError as error:
        raise FileFormatError(path, None, f"cannot be written: {error.strerror}") from None


def _compressed(suffix: str, data: bytes) -> bytes:
    if suffix == ".gz":
        return gzip.compress(data, mtime=0)
    return lzma.compress(data) if suffix == ".xz" else data
