"""The four steps together: the only orchestrators.

stages   how long each step took, and what is told of it
weigh    steps i and ii for every pair of robots: evidence
select   step iii: the closures to believe
within_trials  one map's closures under several scales of odometry's errors
_within_recheck  closures of the largest set that the map which they make contradicts
_within_recall  closures that the largest set leaves out and the cleaned map agrees with
within_decision  the closures of one map to believe, from those
within   all of it inside one robot's map: the loop closures to believe there
_calibration_set  the closures that a calibration goes by
calibrate  by how much odometry and closures misstate their errors
merge    step iv: one map a group
"""

from pcm_jax.pipeline.calibrate import calibrate
from pcm_jax.pipeline.merge import merge
from pcm_jax.pipeline.select import select
from pcm_jax.pipeline.weigh import weigh
from pcm_jax.pipeline.within import clean_maps, select_within

__all__ = ["calibrate", "clean_maps", "merge", "select", "select_within", "weigh"]
