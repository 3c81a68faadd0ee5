"""Targets of results, checked before anything is computed."""

from __future__ import annotations

import gzip
import io
import json
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pcm_jax.errors import FileFormatError, InputError
from pcm_jax.files.output import check_target, write_bytes

_DATES = {"svg": "Date", "pdf": "CreationDate"}


def check_outputs(paths: Sequence[Path], inputs: Sequence[Path]) -> None:
    """Raises `InputError` unless a file can be written at each path, none of them an input."""
    for number, path in enumerate(paths):
        check_target(path)
        if path.exists() and any(given.exists() and path.samefile(given) for given in inputs):
            raise FileFormatError(path, None, "this file is read, expected another one to write to")
        if path.resolve() in [other.resolve() for other in paths[:number]]:
            raise FileFormatError(path, None, "named for two results, expected a file for each")


def check_picture(path: Path) -> None:
    """Raises `InputError` unless matplotlib is there and can write pictures of this kind."""
    try:
        import matplotlib
    except ImportError:
        raise InputError(
            "matplotlib: not installed, but pictures need it: pip install '.[plot]'"
        ) from None
    from matplotlib.backend_bases import FigureCanvasBase

    matplotlib.use("agg")
    known = FigureCanvasBase.get_supported_filetypes()
    if path.suffix.lower().removeprefix(".") not in known:
        raise FileFormatError(
            path,
            None,
            f"suffix {path.suffix!r} given, expected a picture's: {', '.join(sorted(known))}",
        )


def save_picture(path: Path, ax: Any) -> None:
    """Writes the figure that matplotlib axes are in, in the format of the path's suffix.

    The same figure gives the same bytes: without a date, and with ids of elements that are not
    drawn at random.
    """
    import matplotlib

    kind = path.suffix.lower().removeprefix(".")
    form = "svg" if kind == "svgz" else kind
    undated = {_DATES[form]: None} if form in _DATES else None
    picture = io.BytesIO()
    with matplotlib.rc_context({"svg.hashsalt": "pcm_jax"}):
        ax.figure.savefig(picture, format=form, bbox_inches="tight", metadata=undated)
    data = picture.getvalue()
    if form in ("ps", "eps"):
        data = re.sub(rb"(?m)^%%CreationDate: .*\n", b"", data, count=1)
    write_bytes(path, gzip.compress(data, mtime=0) if kind == "svgz" else data)


def json_text(value: Any) -> str:
    """JSON with an indent of two; numbers that are not finite, which JSON lacks, become null."""
    return json.dumps(_finite(value), indent=2, allow_nan=False) + "\n"


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
