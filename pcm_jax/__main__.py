"""`python -m pcm_jax` is `pcm-jax`."""

from pcm_jax.cli import main

if __name__ == "__main__":
    raise SystemExit(main())
