"""JRL, the JSON Robot Log of COSMO-Bench and others: several robots, labels and truth in one file.

Keys are GTSAM symbols whose letter is the robot; quaternions are (w, x, y, z); covariances are
row by row over GTSAM's tangent, rotation first for `Pose3`. `measurements` holds, for each robot,
entries of one time; `potential_outlier_factors` names the loop closures by entry and measurement,
`outlier_factors` the false ones among them, `groundtruth` and `initialization` the poses.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from os import PathLike
from typing import Any, NamedTuple

import jaxlie
import numpy as np

from pcm_jax import lie
from pcm_jax.errors import FileFormatError, InputError
from pcm_jax.files._json import Member, begins_object, load
from pcm_jax.files.coordinates import columns, inverted, parameters
from pcm_jax.files.formats._registry import Format, register
from pcm_jax.files.formats.g2o import as_keys, check_group, closure_keys, original_keys
from pcm_jax.files.names import stem_of
from pcm_jax.files.output import write_text
from pcm_jax.files.pose_file import (
    FALSE,
    TRUE,
    UNKNOWN,
    Lines,
    PoseFile,
    Reading,
    checked,
    no_lines,
)
from pcm_jax.files.scopes import ROBOT_LINE
from pcm_jax.files.source import Source
from pcm_jax.files.text import line_fault
from pcm_jax.graph import symbols
from pcm_jax.graph.multi_robot import MultiRobotGraph
from pcm_jax.graph.validation import check_information

_ORDER = {3: [0, 1, 2], 6: [3, 4, 5, 0, 1, 2]}  # of our tangent's directions in GTSAM's
POSES = 1_000_000_000  # indices below are poses, above landmarks, velocities and biases
NANOSECONDS = 1e14  # stamps above are nanoseconds


class _Factor(NamedTuple):
    """A measurement of poses: what joins which keys, and where it stands."""

    number: int
    robot: str
    place: tuple[int, int]
    stamp: float
    keys: list[int]
    pose: Member
    covariance: Member


def _recognise(source: Source) -> float:
    return 0.9 * (
        begins_object(source)
        and '"measurements"' in source.text[: 1 << 24]
        and '"robots"' in source.text
    )


def read_jrl(source: Source, reading: Reading) -> PoseFile:
    """Reads a data set: measurements, initial poses, truth and labels.

    Raises:
        FileFormatError: naming the place in the file, what is wrong and what was expected.
    """
    whole = load(source)
    factors, left_out = _factors(whole)
    if not factors:
        raise FileFormatError(source.path, None, "no measurement of poses, expected some")
    flat = factors[0].pose.has("theta")
    group: Any = jaxlie.SE2 if flat else jaxlie.SE3
    labels = _labels(whole)
    between = [factor for factor in factors if len(factor.keys) == 2]
    alone = [factor for factor in factors if len(factor.keys) == 1]
    edges = _lines(source.path, between, group, labels) if between else no_lines(group, 2)
    edges, clipped = checked(source.path, edges, reading.repair)
    return PoseFile(
        source.path,
        group,
        _values(whole, ("initialization",), group) or no_lines(group, 1),
        edges,
        clipped=clipped,
        format="jrl",
        left_out=left_out,
        priors=_lines(source.path, alone, group, {}) if alone else None,
        stamps=_stamps(factors),
        truth=_values(whole, ("groundtruth", "ground_truth"), group),
        how="covariances, rotation first",
        comments=[one.text() for one in whole.at("pcm_jax").list()] if whole.has("pcm_jax") else (),
    )


def _factors(whole: Member) -> tuple[list[_Factor], dict[str, int]]:
    """The measurements of poses, and how many others there are of each type."""
    found: list[_Factor] = []
    left_out: dict[str, int] = {}
    number = 0
    for robot, entries in whole.at("measurements").items():
        for index, entry in enumerate(entries.list() if entries.value is not None else []):
            stamp = entry.at("stamp").number()
            seconds = stamp * 1e-9 if stamp > NANOSECONDS else stamp
            listed = entry.at("measurements").list() if entry.has("measurements") else []
            for place, one in enumerate(listed):
                number += 1
                kind = one.at("type").text()
                if kind not in _KINDS:
                    left_out[kind] = left_out.get(kind, 0) + 1
                    continue
                names, pose = _KINDS[kind]
                keys = [one.at(*name).integer() for name in names]
                found.append(
                    _Factor(
                        number,
                        robot,
                        (index, place),
                        seconds,
                        keys,
                        one.at(*pose),
                        one.at("covariance", "cov"),
                    )
                )
    return found, left_out


_ENDS = ((("key1", "k1"), ("key2", "k2")), ("measurement", "mm"))
_ONE = ((("key", "k"),), ("prior", "mm"))
_KINDS = {
    "BetweenFactorPose2": _ENDS,
    "BetweenFactorPose3": _ENDS,
    "PriorFactorPose2": _ONE,
    "PriorFactorPose3": _ONE,
}


def _labels(whole: Member) -> dict[tuple[str, int, int], int]:
    """Labels of measurements, by robot, entry and place; those not listed are true."""
    labels: dict[tuple[str, int, int], int] = {}
    for name, label in (("potential_outlier_factors", TRUE), ("outlier_factors", FALSE)):
        if whole.has(name) and whole.at(name).value is not None:
            for robot, listed in whole.at(name).items():
                for pair in listed.list() if listed.value is not None else []:
                    entry, place = pair.numbers(2).astype(int).tolist()
                    labels[robot, entry, place] = label
    if not whole.has("outlier_factors"):
        return {}
    return {**labels, _ANY: TRUE}


_ANY = ("", -1, -1)  # the label of what no list names


def _lines(
    path: str, factors: list[_Factor], group: Any, labels: dict[tuple[str, int, int], int]
) -> Lines:
    transforms = _transforms([factor.pose for factor in factors], group)
    order = np.array(_ORDER[lie.tangent_dim(group)])
    d = len(order)
    covariance = np.array([factor.covariance.matrix(d) for factor in factors])
    covariance = covariance.reshape(-1, d, d)[:, order[:, None], order]
    line = np.array([factor.number for factor in factors], np.int64)
    fault = line_fault(path, line)
    information = inverted(check_information(covariance, fault, "covariance"))
    default = labels.get(_ANY, UNKNOWN)
    known = [labels.get((factor.robot, *factor.place), default) for factor in factors]
    ids = np.array([factor.keys for factor in factors], np.int64)
    return Lines(
        ids.reshape(len(factors), -1),
        transforms,
        information,
        line,
        label=np.array(known, np.int64),
    )


def _transforms(poses: list[Member], group: Any) -> np.ndarray:
    if group is jaxlie.SE2:
        names = ("x", "y", "theta")
        rows = np.array([[pose.at(name).number() for name in names] for pose in poses])
        return parameters("angle", rows.reshape(-1, 3), _fault_of(poses))
    rows = np.array(
        [[*pose.at("translation").numbers(3), *pose.at("rotation").numbers(4)] for pose in poses]
    ).reshape(-1, 7)
    return parameters("quaternion", rows[:, [0, 1, 2, 4, 5, 6, 3]], _fault_of(poses))


def _fault_of(poses: list[Member]) -> Any:
    return lambda row, problem: poses[row].fault(problem.replace("x y z qx qy qz qw", "w x y z"))


def _values(whole: Member, names: Sequence[str], group: Any) -> Lines | None:
    """Poses by key, without landmarks and the like; None where there are none.

    They stand in a list, each with its key, or by their keys.
    """
    name = next((name for name in names if whole.has(name)), None)
    if name is None or whole.at(name).value is None:
        return None
    kind = "Pose2" if group is jaxlie.SE2 else "Pose3"
    listed: list[tuple[Member, Member]] = []
    for _, values in whole.at(name).items():
        if isinstance(values.value, dict):
            listed += [(values.key(text), one) for text, one in values.items()]
        elif values.value is not None:
            listed += [(one.at("key"), one) for one in values.list()]
    listed = [(key, one) for key, one in listed if one.at("type").value == kind]
    chosen = [one for _, one in listed]
    ids = np.array([key.integer() for key, _ in listed], np.int64)
    own = symbols.indices_of(ids) < POSES
    d = lie.tangent_dim(group)
    lines = Lines(
        ids[:, None],
        _transforms(chosen, group),
        np.zeros((len(ids), d, d)),
        np.arange(len(ids)) + 1,
    )
    return lines[own] if own.any() else None


def _stamps(factors: list[_Factor]) -> tuple[np.ndarray, np.ndarray]:
    """The time of each of a robot's poses: of the entry that names it first."""
    first: dict[int, float] = {}
    for factor in factors:
        for key in factor.keys:
            if chr(int(symbols.letters_of(np.array([key]))[0])) == factor.robot:
                first.setdefault(key, factor.stamp)
    return np.array(list(first), np.int64), np.array(list(first.values()))


def write_jrl(path: str | PathLike[str], graph: MultiRobotGraph) -> None:
    """Writes maps and closures as a JRL data set, whole or not at all; `.gz`, `.xz` compress.

    Loop closures, a map's own included, are the potential outliers; labels and truth are written
    where they are known. Each pose has an entry of its own, with the measurements that end there.

    Args:
        path: the file.
        graph: what to write.

    Raises:
        FileFormatError: for a folder that does not exist or cannot be written to.
        InputError: for another group, and ids that fit no symbol key.
    """
    check_group(graph)
    rank = graph.closures.rank
    if (rank < graph.tangent_dim).any():
        row = int(np.argmax(rank < graph.tangent_dim))
        raise InputError(
            f"closures[{row}]: information of rank {rank[row]} has no covariance, which JRL holds;"
            " expected full rank"
        )
    header, keys = original_keys(graph.maps, own_name=stem_of(str(path)))
    if len(graph.maps) == 1 and not symbols.are_symbols(keys[0]):
        keys = [as_keys("a", graph.maps[0])]
        header = [ROBOT_LINE.format(letter="a", kind="index", name=graph.maps[0].name)]
    robots = [chr(int(symbols.letters_of(own[:1])[0])) for own in keys]
    entries = _entries(graph, keys)
    whole: dict[str, Any] = {
        "name": stem_of(str(path)),
        "robots": list(map(ord, robots)),  # numbers, as JRL's own program reads and writes them
        "measurements": {robot: own.entries for robot, own in zip(robots, entries, strict=True)},
        "initialization": {
            robot: list(_poses(own, one.poses))
            for robot, own, one in zip(robots, keys, graph.maps, strict=True)
        },
        "potential_outlier_factors": {
            robot: own.loops for robot, own in zip(robots, entries, strict=True)
        },
    }
    if graph.closures.is_true is not None:
        whole["outlier_factors"] = {
            robot: own.false for robot, own in zip(robots, entries, strict=True)
        }
    if graph.truth is not None and all(true is not None for true in graph.truth):
        whole["groundtruth"] = {
            robot: list(_poses(own, true))
            for robot, own, true in zip(robots, keys, graph.truth, strict=True)
        }
    if header:
        whole["pcm_jax"] = header  # the robots' names; other programs skip it
    write_text(path, json.dumps(whole))


class _Entries:
    """One robot's measurements as they are written, in entries of one pose each."""

    def __init__(self, keys: np.ndarray, stamps: np.ndarray | None) -> None:
        seconds = np.arange(len(keys)) if stamps is None else np.nan_to_num(stamps) * 1e9
        self.entries: list[dict[str, Any]] = [
            {"stamp": round(float(stamp)), "measurements": []} for stamp in seconds
        ]
        self.loops: list[list[int]] = []
        self.false: list[list[int]] = []

    def add(self, pose: int, factor: dict[str, Any], loop: bool, true: bool | None) -> None:
        """Puts a measurement to a pose's entry."""
        listed = self.entries[pose]["measurements"]
        place = [pose, len(listed)]
        listed.append(factor)
        if loop:
            self.loops.append(place)
        if true is False:
            self.false.append(place)


def _entries(graph: MultiRobotGraph, keys: list[np.ndarray]) -> list[_Entries]:
    out = [_Entries(own, one.stamps) for own, one in zip(keys, graph.maps, strict=True)]
    for own, one, ids in zip(out, graph.maps, keys, strict=True):
        tail, head = np.asarray(one.tail), np.asarray(one.head)
        late = np.maximum(tail, head).tolist()
        loop = (np.abs(tail - head) != 1).tolist()
        factors = _factor_rows(ids[tail], ids[head], one)
        for pose, far, factor in zip(late, loop, factors, strict=True):
            own.add(pose, factor, far, None)
        if one.priors is not None:
            priors = _factor_rows(ids[one.priors.pose], None, one.priors)
            for pose, factor in zip(one.priors.pose.tolist(), priors, strict=True):
                own.add(pose, factor, False, None)
    closures = graph.closures
    tails, heads = closure_keys(graph, keys)
    factors = _factor_rows(tails, heads, closures)
    robot, pose = np.asarray(closures.robot_a).tolist(), np.asarray(closures.pose_a).tolist()
    true = closures.is_true
    for k, factor in enumerate(factors):
        out[robot[k]].add(pose[k], factor, True, None if true is None else bool(true[k]))
    return out


def _factor_rows(
    tail: np.ndarray, head: np.ndarray | None, measured: Any
) -> Iterator[dict[str, Any]]:
    order = np.array(_ORDER[np.asarray(measured.information).shape[-1]])
    covariance = np.linalg.pinv(np.asarray(measured.information), hermitian=True)
    covariance = covariance[:, order[:, None], order].reshape(len(tail), len(order) ** 2).tolist()
    poses = _values_of(measured.measurement)
    kind = "Pose2" if len(order) == 3 else "Pose3"
    for k, (pose, row) in enumerate(zip(poses, covariance, strict=True)):
        if head is None:
            ends = {"type": f"PriorFactor{kind}", "key": int(tail[k]), "prior": pose}
        else:
            ends = {
                "type": f"BetweenFactor{kind}",
                "key1": int(tail[k]),
                "key2": int(head[k]),
                "measurement": pose,
            }
        yield {**ends, "covariance": row}


def _values_of(transforms: Any) -> Iterator[dict[str, Any]]:
    rows = columns(np.asarray(lie.parameters(lie.as_numpy(transforms)))).tolist()
    for row in rows:
        if len(row) == 3:
            yield {"type": "Pose2", "x": row[0], "y": row[1], "theta": row[2]}
        else:
            turn = [row[6], *row[3:6]]
            yield {"type": "Pose3", "translation": row[:3], "rotation": turn}


def _poses(keys: np.ndarray, poses: Any) -> Iterator[dict[str, Any]]:
    for key, value in zip(keys.tolist(), _values_of(poses), strict=True):
        yield {**value, "key": key}


JRL = register(
    Format(
        name="jrl",
        about="several robots' maps and closures",
        recognise=_recognise,
        read=read_jrl,
        write=write_jrl,
        suffixes=(".jrl",),
        information="kept (covariances)",
        priors="kept",
        stamps="kept",
        labels="kept, and true poses",
    )
)
