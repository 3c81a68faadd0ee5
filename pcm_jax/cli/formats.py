"""`pcm-jax formats`: the file formats, and what is kept of each.

The table stands in the docstring of `pcm_jax.files`, where a test keeps it equal to the registry.
It is read there, since to ask the registry itself every reader, and JAX, would have to be imported.
"""

from __future__ import annotations

import ast
import importlib.util
from pathlib import Path
from typing import Any

from pcm_jax.tables import columns_of_text


def run(_: Any) -> None:
    """Prints the table of formats."""
    head, *rows = _table()
    print(columns_of_text(head, rows))


def _table() -> list[list[str]]:
    """The cells of the table, its heading first."""
    source = importlib.util.find_spec("pcm_jax.files").origin  # type: ignore[union-attr]
    text = ast.get_docstring(ast.parse(Path(str(source)).read_text(encoding="utf-8"))) or ""
    lines = [line[2:-2].split(" | ") for line in text.splitlines() if line.startswith("| ")]
    return [cells for cells in lines if set(cells) != {"---"}]
