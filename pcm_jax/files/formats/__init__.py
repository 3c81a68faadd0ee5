"""File formats, one module each; every module here registers what it defines.

_registry       `Format`, and which one a file is in
_tags           the columns of lines that begin with a tag
_tagged         the reader of such lines
_priors         the reader of lines that measure one pose
_annotations    scores in comments, times in folders beside the file
g2o             pose graphs as g2o, and their writer
toro, isam      the older text formats of pose graphs
_uncertainty    columns that state a measurement's uncertainty
candidates      candidate closures as CSV
tum             trajectories: TUM, KITTI, EuRoC
named_poses     trajectories as CSV with column names
jrl             JSON Robot Logs, with labels and truth
open3d          Open3D's pose graphs as JSON
rtabmap         RTAB-Map's databases
ros_bag         ROS bags of pose graphs
gtsam_objects   GTSAM's factor graphs, in memory
"""

import importlib
import pkgutil

from pcm_jax.files.formats._registry import (
    HEAD,
    Format,
    formats,
    markdown,
    named,
    recognised,
    register,
    rows,
    unregister,
)

for _module in pkgutil.iter_modules(__path__):
    importlib.import_module(f"{__name__}.{_module.name}")

__all__ = [
    "HEAD",
    "Format",
    "formats",
    "markdown",
    "named",
    "recognised",
    "register",
    "rows",
    "unregister",
]
