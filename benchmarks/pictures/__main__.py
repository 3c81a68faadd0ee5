"""`python -m benchmarks.pictures`: the picture that `pcm-jax demo` draws, into this folder."""

from __future__ import annotations

import tempfile
from contextlib import chdir
from pathlib import Path

from PIL import Image

from pcm_jax.cli import main as pcm_jax
from pcm_jax.cli._arguments import DEMO_PICTURE

PICTURE = Path(__file__).with_name("demo.png")
COLOURS = 128  # enough for lines and letters; a sixth of the file's size


def main(target: Path = PICTURE) -> None:
    """Runs the demo as a user does, and keeps its picture with fewer colours."""
    with tempfile.TemporaryDirectory() as folder, chdir(folder):
        pcm_jax(["demo"])
        drawn = Image.open(DEMO_PICTURE).convert("RGB")
    drawn.quantize(COLOURS).save(target, optimize=True)


if __name__ == "__main__":
    main()
