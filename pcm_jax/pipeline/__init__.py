"""The four steps together: the only orchestrators.

select   steps i to iii for every robot pair
merge    step iv as well
"""

from pcm_jax.pipeline.merge import merge
from pcm_jax.pipeline.select import select

__all__ = ["merge", "select"]
