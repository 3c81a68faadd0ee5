"""iSAM's text: `EDGE2`, `EDGE3`, `ODOMETRY`, without vertices."""

from __future__ import annotations

from pcm_jax.files.formats._registry import Format, register
from pcm_jax.files.formats._tagged import read_tagged, tagged_lines

ISAM = register(
    Format(
        name="isam",
        about="measurements between poses, 2D and 3D",
        recognise=lambda source: tagged_lines(source, "isam"),
        read=read_tagged,
        information="kept, turned into the end frame",
    )
)
