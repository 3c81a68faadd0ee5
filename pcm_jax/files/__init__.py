"""Reading and writing pose graphs and trajectories."""

from pcm_jax.files.candidates import write_candidates
from pcm_jax.files.gtsam_graphs import from_gtsam, to_gtsam
from pcm_jax.files.read import read_graph
from pcm_jax.files.tum import read_trajectory, read_tum, write_trajectory
from pcm_jax.files.write import write_g2o

__all__ = [
    "from_gtsam",
    "read_graph",
    "read_trajectory",
    "read_tum",
    "to_gtsam",
    "write_candidates",
    "write_g2o",
    "write_trajectory",
]
