"""`python -m pcm_jax` is `pcm-jax`."""

from pcm_jax.cli import console

if __name__ == "__main__":
    console()
