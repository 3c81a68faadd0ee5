"""Reading and writing pose graphs and trajectories, in whatever format a team has them.

source          one file as bytes and lines, read whole, within a bound
text, _json     tables of numbers and JSON members that know their place, for messages
coordinates     a file's columns as transforms, with information over the tangent
formats/        one module a format: how it is recognised by content, read and written
pose_file       what one file holds, as arrays, and how its numbers are to be taken
trajectories    trajectories as maps
_scope          whose poses a file's ids are: what the rules decide
_shared_ids, _conflicts, _components     three of the rules
scopes          the rules
names           what robots are called, and what candidates may call them
_table          lines of all files, end to end
robots          from these to maps and closures
_lettered       candidates that call robots by letters of their own
_named          candidates whose robots are named
plausibility    doubts about how information was read
account         what was read and how, for people
assembly        from what files hold to one graph, closures counted once
read, write     the front doors: `read_graph`, `read_candidates`, `write_graph`
_replaced       a folder in another's place, at once
output          files that are written whole or not at all

| format | holds | read | written | information | priors | times | labels |
| --- | --- | --- | --- | --- | --- | --- | --- |
| csv | candidate closures | yes | .csv | kept; standard deviations and covariances too; the maps' median where none is given | none | none | kept (is_true) |
| euroc | a trajectory, 3D | yes | no | of each step: --sigmas M RAD | none | kept | none |
| g2o | pose graphs, 2D and 3D | yes | .g2o | kept | kept | hdl_graph_slam's | none |
| isam | measurements between poses, 2D and 3D | yes | no | kept, turned into the end frame | none | none | none |
| jrl | several robots' maps and closures | yes | .jrl | kept (covariances) | kept | kept | kept, and true poses |
| kitti | a trajectory, 3D | yes | no | of each step: --sigmas M RAD | none | none | none |
| open3d | Open3D's pose graph, uncertain edges as candidates | yes | .json | kept | none | none | none |
| poses | trajectories as CSV with column names | yes | no | of each step: --sigmas M RAD | none | kept | none |
| rosbag | ROS bags of pose_graph_tools_msgs/PoseGraph | yes | no | kept (covariances) | none | kept | none |
| rtabmap | RTAB-Map's database | yes | no | kept | kept | kept | true poses |
| toro | pose graphs, 2D and 3D | yes | no | kept, turned into the end frame | none | none | none |
| tum | a trajectory, 3D | yes | no | of each step: --sigmas M RAD | none | kept | none |
"""  # noqa: E501

from pcm_jax.files.formats.candidates import write_candidates
from pcm_jax.files.formats.g2o import write_g2o
from pcm_jax.files.formats.gtsam_objects import from_gtsam, to_gtsam
from pcm_jax.files.formats.tum import read_trajectory, read_tum, write_trajectory
from pcm_jax.files.read import read_candidates, read_graph
from pcm_jax.files.write import write_graph

__all__ = [
    "from_gtsam",
    "read_candidates",
    "read_graph",
    "read_trajectory",
    "read_tum",
    "to_gtsam",
    "write_candidates",
    "write_g2o",
    "write_graph",
    "write_trajectory",
]
