"""Reports that `merge --report` wrote, read again without anything heavy."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from pcm_jax.errors import FileFormatError

OURS = ("version", "method", "robots", "closures", "robot_pairs", "groups")
OF_CLOSURE = ("index", "a", "b", "accepted", "why")


def read_report(path: Path) -> dict[str, Any]:
    """The report in a file.

    Raises:
        FileFormatError: for what is no JSON, or no report of a merge with its explanations.
    """
    try:
        report = json.loads(path.read_text(encoding="utf-8"))
    except UnicodeDecodeError:
        raise not_ours(path, "no text") from None
    except json.JSONDecodeError as error:
        raise FileFormatError(path, error.lineno, f"no JSON: {error.msg}") from None
    except (RecursionError, ValueError) as error:  # lists in lists, integers of thousands of digits
        raise FileFormatError(path, None, f"no JSON: {error}") from None
    if not isinstance(report, dict):
        raise not_ours(path, f"a JSON {type(report).__name__}")
    for key in OURS:
        if key not in report:
            raise not_ours(path, f"JSON without {key!r}")
    if not isinstance(report["closures"], list):
        raise not_ours(path, "closures that are no list")
    for number, row in enumerate(report["closures"]):
        missing = [key for key in OF_CLOSURE if not isinstance(row, dict) or key not in row]
        if missing:
            raise not_ours(path, f"closures[{number}] without {missing[0]!r}")
    return report


def not_ours(path: Path, found: str) -> FileFormatError:
    """The error for a file that is no report of a merge."""
    return FileFormatError(
        path, None, f"{found}, expected a report that pcm-jax merge --report of this version wrote"
    )
