"""The four steps together: the only orchestrators.

stages   how long each step took, and what is told of it
weigh    steps i and ii for every pair of robots: evidence
select   step iii: the closures to believe
merge    step iv: one map a group
"""

from pcm_jax.pipeline.merge import merge
from pcm_jax.pipeline.select import select
from pcm_jax.pipeline.weigh import weigh

__all__ = ["merge", "select", "weigh"]
