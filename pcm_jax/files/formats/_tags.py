"""The lines of pose-graph files by their first word, and what they hold.

| format | 2D | 3D |
|---|---|---|
| g2o | `VERTEX_SE2 id x y θ`, `EDGE_SE2 i j x y θ Ω` | `VERTEX_SE3:QUAT id x y z qx qy qz qw`, `EDGE_SE3:QUAT i j x y z qx qy qz qw Ω` |
| TORO | `VERTEX2 id x y θ`, `EDGE2 i j x y θ Ω` | `VERTEX3 id x y z roll pitch yaw`, `EDGE3 i j x y z roll pitch yaw Ω` |
| iSAM | `EDGE2` or `ODOMETRY`, as above | `EDGE3`, as above |

Ω is one triangle of a symmetric matrix: row by row in all but TORO's 2D lines, which give
I11 I12 I22 I33 I13 I23.
"""  # noqa: E501

from __future__ import annotations

import dataclasses

import jaxlie

COLUMNS = {
    "angle": ("x", "y", "theta"),
    "quaternion": ("x", "y", "z", "qx", "qy", "qz", "qw"),
    "euler": ("x", "y", "z", "roll", "pitch", "yaw"),
}


@dataclasses.dataclass(frozen=True)
class Tag:
    """The columns of one kind of line.

    Attributes:
        edge: whether it is an edge (two ids and information) or a vertex (one id).
        coordinates: key of `COLUMNS`.
        formats: the formats that have it.
        skipped: columns after the ids that say nothing of the measurement (a switch's id).
    """

    edge: bool
    coordinates: str
    formats: tuple[str, ...]
    skipped: int = 0

    @property
    def group(self) -> type:
        """`jaxlie.SE2` or `jaxlie.SE3`."""
        return jaxlie.SE2 if self.coordinates == "angle" else jaxlie.SE3

    @property
    def ids(self) -> int:
        """Number of id columns."""
        return 2 if self.edge else 1

    @property
    def triangle(self) -> int:
        """Number of information columns."""
        return 0 if not self.edge else 6 if self.group is jaxlie.SE2 else 21

    @property
    def width(self) -> int:
        """Number of words in a line, the tag included."""
        return self.start + len(COLUMNS[self.coordinates]) + self.triangle

    @property
    def start(self) -> int:
        """The first column of coordinates."""
        return 1 + self.ids + self.skipped

    @property
    def layout(self) -> str:
        """The columns in words."""
        ends = ("id", "id") if self.edge else ("id",)
        names = ["tag", *ends, *("switch",) * self.skipped, *COLUMNS[self.coordinates]]
        information = f" and {self.triangle} of information" if self.edge else ""
        return " ".join(names) + information


TAGS = {
    "VERTEX_SE2": Tag(False, "angle", ("g2o",)),
    "EDGE_SE2": Tag(True, "angle", ("g2o",)),
    "VERTEX_SE3:QUAT": Tag(False, "quaternion", ("g2o",)),
    "EDGE_SE3:QUAT": Tag(True, "quaternion", ("g2o",)),
    # What RTAB-Map writes for tags with an attitude; Vertigo's robust edges, whose switches and
    # weights another program's optimiser wants.
    "EDGE_SE3": Tag(True, "quaternion", ("g2o",)),
    "EDGE_SE2_SWITCHABLE": Tag(True, "angle", ("g2o",), 1),
    "EDGE_SE3_SWITCHABLE": Tag(True, "quaternion", ("g2o",), 1),
    "EDGE_SE3:QUAT_SWITCHABLE": Tag(True, "quaternion", ("g2o",), 1),
    "EDGE_SE2_MAXMIX": Tag(True, "angle", ("g2o",), 1),
    "EDGE_SE3_MAXMIX": Tag(True, "quaternion", ("g2o",), 1),
    "EDGE_SE3:QUAT_MAXMIX": Tag(True, "quaternion", ("g2o",), 1),
    "VERTEX2": Tag(False, "angle", ("toro",)),
    "VERTEX3": Tag(False, "euler", ("toro",)),
    "EDGE2": Tag(True, "angle", ("toro", "isam")),
    "EDGE3": Tag(True, "euler", ("toro", "isam")),
    "ODOMETRY": Tag(True, "angle", ("isam",)),
    "ODOMETRY2": Tag(True, "angle", ("isam",)),
    "ODOMETRY3": Tag(True, "euler", ("isam",)),
}

# Which pose is held fixed: every solver here fixes the first one.
SILENT = ("FIX",)

# Landmarks, priors, sensor offsets, calibration, cameras and raw data of g2o, TORO and iSAM.
SKIPPED_PREFIXES = (
    "PARAMS_",
    "CACHE_",
    "VERTEX_XY",
    "VERTEX_SE3:EXPMAP",
    "EDGE_SE3:EXPMAP",
    "VERTEX_POINT",
    "VERTEX_TRACKXYZ",
    "VERTEX_SEGMENT2D",
    "VERTEX_LINE",
    "VERTEX_PLANE",
    "VERTEX_CAM",
    "VERTEX_INTRINSICS",
    "VERTEX_ODOM",
    "VERTEX_SWITCH",
    "VERTEX_TAG",
    "VERTEX_ELLIPSE",
    "EDGE_PRIOR",
    "EDGE_SWITCH_PRIOR",
    "EDGE_SE2_PRIOR",
    "EDGE_SE2_XY",
    "EDGE_SE2_OFFSET",
    "EDGE_SE2_POINT",
    "EDGE_SE2_TWOPOINTS",
    "EDGE_SE2_LOTSOF",
    "EDGE_SE2_SEGMENT",
    "EDGE_SE2_LINE",
    "EDGE_SE2_CALIB",
    "EDGE_SE2_SENSOR",
    "EDGE_SE2_ODOM",
    "EDGE_SE3_PRIOR",
    "EDGE_SE3_XYZ",
    "EDGE_SE3_TRACKXYZ",
    "EDGE_SE3_OFFSET",
    "EDGE_SE3_CALIB",
    "EDGE_SE3_LOTSOF",
    "EDGE_SE3_LINE",
    "EDGE_SE3_PLANE",
    "EDGE_SE3_POINT",
    "EDGE_BEARING",
    "EDGE_POINT",
    "EDGE_LINE",
    "EDGE_PLANE",
    "EDGE_PROJECT",
    "EDGE_XY",
    "ROBOTLASER",
    "RAWLASER",
    "FLASER",
    "LANDMARK",
)
SKIPPED = ("POINT2", "POINT3", "EQUIV", "BR")


def is_skipped(tag: str) -> bool:
    """True if a line is known and of no use to a pose graph."""
    return tag in SKIPPED or tag.startswith(SKIPPED_PREFIXES)
