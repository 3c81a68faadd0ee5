"""TORO's text: `VERTEX2`, `VERTEX3`, `EDGE2`, `EDGE3`."""

from __future__ import annotations

from pcm_jax.files.formats._registry import Format, register
from pcm_jax.files.formats._tagged import read_tagged, tagged_lines

TORO = register(
    Format(
        name="toro",
        about="pose graphs, 2D and 3D",
        recognise=lambda source: tagged_lines(source, "toro"),
        read=read_tagged,
        information="kept, turned into the end frame",
    )
)
