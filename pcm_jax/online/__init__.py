"""The same four steps, one closure or one pose at a time: the answer of the batch at every step.

_room          arrays that grow at their end without a copy each time
_maps          maps that grow: new poses and edges, checked and joined to those before
_arrivals      closures that come: which state an earlier one again, which wait for their poses
_steady        answers that do not flicker, and the log of what entered and left them
_pair          what is held of one pair of robots: its graph, and the largest clique of that
_state         all of it together, changed as a whole or not at all
_answer        the last step of `select`, with what is known from before
_merged        the maps merged by an answer
_saved         the whole state in one file, and back
incremental    `IncrementalPcm`, which walks through them
_held_within   what is held of the closures inside one map
within         `IncrementalWithin`: the same for one robot
"""

from pcm_jax.online._steady import Change
from pcm_jax.online.incremental import IncrementalPcm
from pcm_jax.online.within import IncrementalWithin

__all__ = ["Change", "IncrementalPcm", "IncrementalWithin"]
