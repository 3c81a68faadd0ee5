"""Reading and writing pose graphs and trajectories."""

from pcm_jax.files.read import read_graph

__all__ = ["read_graph"]
