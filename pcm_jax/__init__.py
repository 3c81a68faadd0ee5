"""Pairwise consistent measurement set maximization (PCM) in JAX.

The names of the public interface are loaded when first used, so that
`import pcm_jax` costs little more than `import jax`.
"""

__version__ = "0.1.0"
