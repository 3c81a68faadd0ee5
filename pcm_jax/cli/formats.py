"""`pcm-jax formats`: the file formats, and what is kept of each."""

from __future__ import annotations

from typing import Any

from pcm_jax.files.formats import HEAD, rows
from pcm_jax.tables import columns_of_text


def run(_: Any) -> None:
    """Prints the registry's table."""
    print(columns_of_text(HEAD, rows()))
