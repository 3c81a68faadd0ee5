"""Facts that front ends put beside a g2o file's lines.

| program | where | what |
|---|---|---|
| ROMAN | a comment `# LC: n` before an edge | n, how much was matched: the edge's weight |
| hdl_graph_slam | `000000/data`, `000001/data`, … beside the file | `stamp seconds nanoseconds` and `id vertex` of a keyframe |
"""  # noqa: E501

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from pcm_jax.errors import FileFormatError
from pcm_jax.files.text import line_fault

SCORE = re.compile(r"#\s*LC\s*:\s*(\S+)\s*$")
MOST_BYTES = 1 << 16  # of a keyframe's text: stamp, two poses, a distance, an id


def scores(
    path: str, lines: Sequence[str], comments: Sequence[str], edges: Int[np.ndarray, " k"]
) -> Float[np.ndarray, " k"] | None:
    """The weight of each edge: the number of the `# LC: n` right before it, else 1.

    Args:
        path: the file.
        lines: of the file.
        comments: of the file, without their numbers: where none is a score nothing is looked for.
        edges: 1-based line of each edge.

    Returns:
        None where no comment is a score.

    Raises:
        FileFormatError: for a score that is no number of at least 0.
    """
    if not any(SCORE.match(comment.strip()) for comment in comments):
        return None
    weight, before = np.ones(len(edges)), np.full(len(lines) + 1, np.nan)
    for number, line in enumerate(lines, start=1):
        found = SCORE.match(line.strip())
        if found:
            before[number] = _score(path, number, found[1])
    after = edges - 1
    scored = (after >= 1) & ~np.isnan(before[after])
    weight[scored] = before[after[scored]]
    return weight


def _score(path: str, number: int, text: str) -> float:
    try:
        score = float(text)
    except ValueError:
        score = np.nan
    if not 0.0 <= score < np.inf:
        fault = line_fault(path, np.array([number]))
        raise fault(0, f"{text!r} given after '# LC:', expected a number of at least 0")
    return score


def keyframe_stamps(path: str) -> tuple[Int[np.ndarray, " k"], Float[np.ndarray, " k"]] | None:
    """Ids and seconds of the keyframes in the folders beside a file; None where there are none.

    Raises:
        FileFormatError: for a `data` file whose `stamp` or `id` cannot be read.
    """
    found = dict(itertools.chain.from_iterable(map(_keyframe, _keyframes(Path(path).parent))))
    if not found:
        return None
    ids = np.array(sorted(found), np.int64)
    return ids, np.array([found[pose] for pose in ids.tolist()])


def _keyframes(folder: Path) -> Iterator[Path]:
    """The files 000000/data, 000001/data, …, as long as they go on."""
    for number in itertools.count():
        file = folder / f"{number:06d}" / "data"
        if not file.is_file():
            return
        yield file


def _keyframe(file: Path) -> Iterator[tuple[int, float]]:
    """The vertex and the seconds of a keyframe; nothing where its file lacks either."""
    try:
        with file.open(encoding="utf-8", errors="replace") as text:
            lines = text.read(MOST_BYTES).splitlines()
    except OSError as error:
        reason = error.strerror or error
        raise FileFormatError(str(file), None, f"cannot be read: {reason}") from None
    values: dict[str, int | float] = {}
    for number, line in enumerate(lines, start=1):
        words = line.split()
        try:
            if words[:1] == ["stamp"]:
                values["stamp"] = int(words[1]) + 1e-9 * int(words[2])
            elif words[:1] == ["id"]:
                values["id"] = int(words[1])
        except (ValueError, IndexError):
            raise FileFormatError(
                str(file), number, f"{line.strip()[:40]!r} given, expected 'stamp s ns' or 'id n'"
            ) from None
    if len(values) == 2 and 0 <= values["id"] < 2**63:
        yield int(values["id"]), float(values["stamp"])
