"""`pcm-jax formats`: the file formats, and what is kept of each."""

from __future__ import annotations

from typing import Any

from pcm_jax.cli._table import table
from pcm_jax.files.formats import HEAD, rows


def run(_: Any) -> None:
    """Prints the registry's table."""
    print(table(HEAD, rows()))
