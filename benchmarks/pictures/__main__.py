"""`python -m benchmarks.pictures`: draws what `pcm-jax demo` draws, into this folder."""

from __future__ import annotations

from pathlib import Path

from PIL import Image

from pcm_jax.cli import demo
from pcm_jax.simulation import simulate_city

PICTURE = Path(__file__).with_name("demo.png")
COLOURS = 128  # enough for lines and letters; a sixth of the file's size


def main() -> None:
    """Simulates, merges both ways and draws."""
    world = simulate_city()
    outcomes = demo.merged_both_ways(world)
    demo.draw(world, outcomes, PICTURE)
    Image.open(PICTURE).convert("RGB").quantize(COLOURS).save(PICTURE, optimize=True)
    print(demo.comparison(world, outcomes))


if __name__ == "__main__":
    main()
