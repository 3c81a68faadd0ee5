"""One file as bytes and as lines: read whole, decompressed, within a bound."""

from __future__ import annotations

import functools
import gzip
import io
import lzma
import re
import stat
import sys
import zlib
from os import PathLike
from pathlib import Path
from typing import IO, Any

from pcm_jax.errors import FileFormatError

GZIP_MAGIC, XZ_MAGIC = b"\x1f\x8b", b"\xfd7zXZ\x00"
LIMIT = 1 << 30  # bytes after decompression: a graph of millions of edges
CHUNK = 1 << 20
BLANK = 16 << 20  # bytes of nothing but white space: each may be a line, which is split off
PIPED = "-"
HEAD = 200  # lines that tell a format


class Source:
    """A file that is read once, when something of it is first asked for.

    Attributes:
        path: as the caller wrote it; "-" is what comes on standard input.
        limit: bytes after decompression that it may have.
    """

    def __init__(self, path: str | PathLike[str], limit: int | None = None) -> None:
        self.path = str(path)
        self.limit = LIMIT if limit is None else limit

    @functools.cached_property
    def is_folder(self) -> bool:
        """True if this is a folder, as some formats are."""
        try:
            return Path(self.path).is_dir()
        except (OSError, ValueError):
            return False

    @functools.cached_property
    def magic(self) -> bytes:
        """The first 32 bytes as they are stored; none of a folder.

        Raises:
            FileFormatError: as `data`.
        """
        if self.is_folder:
            return b""
        with self._open() as file:
            return file.read(32)

    @functools.cached_property
    def data(self) -> bytes:
        """All bytes, decompressed if the first ones say gzip or xz.

        Raises:
            FileFormatError: for a file that is missing, unreadable, no regular file, more than
                `limit` bytes, binary (a zero byte), blank for 16 MiB, or compressed and damaged or
                cut short.
        """
        try:
            with self._open() as file, _decompressed(file) as stream:
                return _bounded(self.path, stream, self.limit)
        except (EOFError, OSError, lzma.LZMAError, zlib.error) as error:
            raise FileFormatError(
                self.path, None, f"damaged or truncated compressed file: {str(error).lower()}"
            ) from None

    @functools.cached_property
    def text(self) -> str:
        """The text, its lines ended by newlines only.

        Raises:
            FileFormatError: as `data`, and for bytes that are no UTF-8.
        """
        data = self.data
        try:
            text = data.decode("utf-8-sig")
        except UnicodeDecodeError as error:
            line = data.count(b"\n", 0, error.start) + 1
            raise FileFormatError(
                self.path, line, f"binary data (byte {data[error.start]:#04x}), expected text"
            ) from None
        return text.replace("\r\n", "\n")

    @functools.cached_property
    def lines(self) -> list[str]:
        """The lines of text."""
        return self.text.split("\n")

    @functools.cached_property
    def head(self) -> list[tuple[int, str]]:
        """The first lines that are neither blank nor comments, with their numbers."""
        found = []
        for number, line in enumerate(self.lines, start=1):
            text = line.strip()
            if text and not text.startswith("#"):
                found.append((number, text))
                if len(found) == HEAD:
                    break
        return found

    def comment_before(self, line: int) -> list[str] | None:
        """The words of the comment right above a line, which may name columns and their units."""
        above = self.lines[int(line) - 2].strip() if line > 1 else ""
        bare = re.sub(r"\[[^\]]*\]|\([^)]*\)", "", above)
        return re.findall(r"[^\s,;#\"]+", bare) if above.startswith("#") else None

    def _open(self) -> IO[bytes]:
        return io.BytesIO(self._piped) if self.path == PIPED else _opened(self.path)

    @functools.cached_property
    def _piped(self) -> bytes:
        """All that comes on standard input, which can be read once only."""
        if sys.stdin is None or sys.stdin.closed:
            raise FileFormatError(self.path, None, "standard input is closed, expected a pipe")
        data = sys.stdin.buffer.read(self.limit + 1)
        if len(data) > self.limit:
            raise _too_long(self.path, self.limit)
        return data

    def without_line(self, number: int) -> None:
        """Blanks one line, so that the file can be read without it."""
        self.lines[number - 1] = ""
        self.__dict__.pop("head", None)


def read_lines(path: str | PathLike[str]) -> list[str]:
    """The lines of a text file, which may be gzip- or xz-compressed (told by its first bytes).

    Raises:
        FileFormatError: as `Source.data` and `Source.text`.
    """
    return Source(path).lines


def _opened(path: str) -> IO[bytes]:
    """A regular file; a pipe or a device might never end, or never begin."""
    try:
        kind = Path(path).stat().st_mode
        if stat.S_ISDIR(kind):
            raise FileFormatError(path, None, "this is a folder, expected a file")
        if not stat.S_ISREG(kind):
            raise FileFormatError(
                path, None, "this is a pipe or a device, expected a file, or - for standard input"
            )
        return Path(path).open("rb")
    except FileNotFoundError:
        raise FileFormatError(path, None, "there is no such file") from None
    except FileFormatError:
        raise
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise FileFormatError(path, None, f"cannot be read: {reason}") from None


def _decompressed(file: IO[bytes]) -> Any:
    head = file.read(len(XZ_MAGIC))
    file.seek(0)
    if head.startswith(GZIP_MAGIC):
        return gzip.GzipFile(fileobj=file)
    return lzma.LZMAFile(file) if head.startswith(XZ_MAGIC) else file


def _too_long(path: str, limit: int) -> FileFormatError:
    size = f"{limit >> 20} MiB" if limit >= 1 << 20 else f"{limit} bytes"
    return FileFormatError(
        path, None, f"more than {size} of text (byte_limit=, --byte-limit, allows more)"
    )


def _bounded(path: str, stream: IO[bytes], limit: int) -> bytes:
    """The stream's bytes, looked at as they come: what is binary or endless is refused early."""
    whole, size, lines, blank = io.BytesIO(), 0, 0, 0
    while chunk := stream.read(CHUNK):
        if b"\0" in chunk:
            line = lines + chunk.count(b"\n", 0, chunk.index(b"\0")) + 1
            raise FileFormatError(path, line, "binary data (a zero byte), expected text")
        size, lines = size + len(chunk), lines + chunk.count(b"\n")
        if size > limit:
            raise _too_long(path, limit)
        blank = blank + len(chunk) if chunk.isspace() else 0
        if blank >= BLANK:
            raise FileFormatError(path, lines, f"{blank >> 20} MiB of white space, expected text")
        whole.write(chunk)
    return whole.getvalue()
