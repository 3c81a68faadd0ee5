"""Reading and writing pose graphs and trajectories."""

from pcm_jax.files.formats.candidates import write_candidates
from pcm_jax.files.formats.g2o import write_g2o
from pcm_jax.files.formats.gtsam_objects import from_gtsam, to_gtsam
from pcm_jax.files.formats.tum import read_trajectory, read_tum, write_trajectory
from pcm_jax.files.read import read_graph
from pcm_jax.files.write import write_graph

__all__ = [
    "from_gtsam",
    "read_graph",
    "read_trajectory",
    "read_tum",
    "to_gtsam",
    "write_candidates",
    "write_g2o",
    "write_graph",
    "write_trajectory",
]
