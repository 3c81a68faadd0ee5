"""One file's contents as arrays: ids, transforms and information, with their lines.

What the ids mean (whose poses they are) is decided later, over all files together.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from pcm_jax import lie
from pcm_jax.errors import InputError, check_choice
from pcm_jax.files._scope import Scope
from pcm_jax.files.source import LIMIT
from pcm_jax.files.text import line_fault
from pcm_jax.graph import symbols
from pcm_jax.graph.validation import Fault, check_information, clip_to_definite, raise_first

SURE = 1e-9
"""Share of an entry of the diagonal left as its pivot: no test of definiteness then fails."""
INFORMATION = ("as-written", "sqrt", "covariance")
ROTATION_INFORMATION = ("tangent", "quaternion")
REPAIR = (None, "clip")
IDS = ("auto", "per-file", "shared", "symbols")
UNKNOWN, FALSE, TRUE = -1, 0, 1  # labels of edges


@dataclasses.dataclass(frozen=True)
class Reading:
    """The reading of a file's numbers: `read_graph`'s options, checked.

    `group` is that of the maps, where they were read before; `components` makes a robot of each
    session of a file that no odometry links to another; `byte_limit` bounds what a file may have
    after decompression.

    Raises:
        InputError: for a value that is not one of those expected.
    """

    information: str = "as-written"
    rotation_information: str = "tangent"
    repair: str | None = None
    format: str | None = None
    ids: str = "auto"
    default_sigmas: tuple[float, float] | None = None
    group: type[Any] | None = None
    components: bool = False
    byte_limit: int = LIMIT

    def __post_init__(self) -> None:
        if not isinstance(self.byte_limit, int | np.integer) or self.byte_limit < 1:
            raise InputError(f"byte_limit: {self.byte_limit!r} given, expected bytes, at least 1")
        allowed = {
            "information": INFORMATION,
            "rotation_information": ROTATION_INFORMATION,
            "repair": REPAIR,
            "ids": IDS,
        }
        for argument, values in allowed.items():
            check_choice(argument, getattr(self, argument), values)
        if self.default_sigmas is not None:
            object.__setattr__(self, "default_sigmas", _sigmas(self.default_sigmas))

    def default_information(self, group: type[Any]) -> Float[np.ndarray, "d d"] | None:
        """Information of a measurement that comes without, by `default_sigmas`, else None."""
        if self.default_sigmas is None:
            return None
        space = lie.module_of(group).MATRIX_DIM - 1
        sigmas = np.full(lie.tangent_dim(group), self.default_sigmas[1])
        sigmas[:space] = self.default_sigmas[0]
        return np.diag(sigmas**-2.0)


def _sigmas(given: Any) -> tuple[float, float]:
    """Two positive numbers, metres and radians."""
    try:
        translation, rotation = (float(sigma) for sigma in given)
    except (TypeError, ValueError):
        raise InputError(
            f"default_sigmas: {given!r} given, expected two numbers, metres and radians"
        ) from None
    for sigma in (translation, rotation):
        if not 1e-30 < sigma < 1e30:
            raise InputError(f"default_sigmas: {sigma:g} given, expected a positive number")
    return translation, rotation


@dataclasses.dataclass(frozen=True)
class Lines:
    """Vertices, edges or priors in the order of their lines.

    Attributes:
        ids: int64 `[k, 1]` (vertices, priors) or `[k, 2]` (edges).
        transforms: jaxlie's parameters, `[k, 4]` or `[k, 7]`.
        information: `[k, d, d]` over the tangent; zeros for vertices.
        line: int64 `[k]`.
        weight: float64 `[k]`, a front end's score; 1 where it gave none.
        label: int64 `[k]`, `TRUE`, `FALSE` or `UNKNOWN`, for edges.
    """

    ids: Int[np.ndarray, "k ends"]
    transforms: Float[np.ndarray, "k p"]
    information: Float[np.ndarray, "k d d"]
    line: Int[np.ndarray, " k"]
    weight: Float[np.ndarray, " k"] = None  # type: ignore[assignment]
    label: Int[np.ndarray, " k"] = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        if self.weight is None:
            object.__setattr__(self, "weight", np.ones(len(self.line)))
        if self.label is None:
            object.__setattr__(self, "label", np.full(len(self.line), UNKNOWN))

    def __len__(self) -> int:
        return len(self.line)

    def __getitem__(self, rows: np.ndarray) -> Lines:
        return Lines(**{f.name: getattr(self, f.name)[rows] for f in dataclasses.fields(self)})


@dataclasses.dataclass(frozen=True)
class PoseFile:
    """One file's contents.

    Attributes:
        path: the file.
        group: `jaxlie.SE2` or `jaxlie.SE3`.
        vertices: its poses.
        edges: its measurements; information that is singular is for closures alone.
        comments: its comment lines.
        clipped: how many information matrices were repaired.
        format: the format's name.
        scope: whose the ids are, where the format itself says so.
        named: object `[k, 2]`, the edges' robots by name, in files of candidates that name them.
        left_out: how many lines of each kind say nothing of a pose graph.
        notes: what else a user should know, one line each.
        priors: poses measured by themselves; None for none.
        stamps: ids and seconds of poses that have a time.
        truth: true poses, by id; None where the file has none.
        how: in words, how the information was read.
        candidates: whether its edges are candidates and it defines no map.
        bare: whether its edges came without information, and have none yet.
        lettered: whether its candidates call robots by letters of the file's own (`_lettered`).
    """

    path: str
    group: type[Any]
    vertices: Lines
    edges: Lines
    comments: Sequence[str] = ()
    clipped: int = 0
    format: str = ""
    scope: Scope | None = None
    named: np.ndarray | None = None
    left_out: Mapping[str, int] = dataclasses.field(default_factory=dict)
    notes: Sequence[str] = ()
    priors: Lines | None = None
    stamps: tuple[Int[np.ndarray, " k"], Float[np.ndarray, " k"]] | None = None
    truth: Lines | None = None
    how: str = ""
    candidates: bool = False
    bare: bool = False
    lettered: bool = False

    @property
    def ids(self) -> Int[np.ndarray, " k"]:
        """int64 `[k]`: every id that the file names."""
        return np.concatenate([self.vertices.ids.ravel(), self.edges.ids.ravel()])


def no_lines(group: type[Any], ends: int) -> Lines:
    """No vertices (`ends` 1) or edges (2) of a group."""
    d = lie.tangent_dim(group)
    return Lines(
        ids=np.zeros((0, ends), np.int64),
        transforms=np.zeros((0, lie.module_of(group).PARAMETERS_DIM)),
        information=np.zeros((0, d, d)),
        line=np.zeros(0, np.int64),
    )


def in_order(group: type[Any], parts: Sequence[Lines], ends: int) -> Lines:
    """Lines of several kinds, in the file's order."""
    if len(parts) == 1:
        return parts[0]
    joined = {
        field.name: np.concatenate(
            [getattr(part, field.name) for part in (no_lines(group, ends), *parts)]
        )
        for field in dataclasses.fields(Lines)
    }
    order = np.argsort(joined["line"], kind="stable")
    return Lines(**{name: values[order] for name, values in joined.items()})


def checked(path: str, edges: Lines, repair: str | None) -> tuple[Lines, int]:
    """Edges with their information as by `definite`; how many were repaired."""
    information, clipped = definite(edges.information, line_fault(path, edges.line), repair)
    return dataclasses.replace(edges, information=information), clipped


def without_self_loops(file: PoseFile) -> PoseFile:
    """Leaves out candidates from a pose to itself, which say nothing, with a note.

    Raises:
        FileFormatError: for such an edge of a map.
    """
    edges = file.edges
    loops = edges.ids[:, 0] == edges.ids[:, 1]
    if file.named is not None or not loops.any():
        return file
    if not file.candidates:
        raise_first(
            loops,
            line_fault(file.path, edges.line),
            lambda row: (
                f"edge from pose {symbols.key_text(int(edges.ids[row, 0]))} to itself, expected two"
                " different poses"
            ),
        )
    note = f"{int(loops.sum())} candidates from a pose to itself left out"
    kept = edges[np.flatnonzero(~loops)]
    return dataclasses.replace(file, edges=kept, notes=(*file.notes, note))


def definite(
    information: Float[np.ndarray, "e d d"], fault: Fault, repair: str | None
) -> tuple[Float[np.ndarray, "e d d"], int]:
    """Information `[e, d, d]` without a negative eigenvalue, and how many were clipped for that.

    What lacks some directions (`graph.unsaid`) may be a closure's, and is kept where nothing is to
    be repaired; a map's own edges lack none (`check_definite`).

    Raises:
        InputError: through `fault`, for one that has a negative eigenvalue, or is zero.
    """
    if repair == "clip":
        information, clipped = clip_to_definite(information)
        return check_information(information, fault), clipped
    return check_information(information, _hinted(fault), singular=True), 0


def check_definite(information: Float[np.ndarray, "e d d"], fault: Fault) -> None:
    """Raises `InputError` through `fault` unless a map's edges have positive definite information.

    Args:
        information: of `definite`.
        fault: names the culprit.
    """
    try:
        own = np.linalg.cholesky(information) ** 2
        pivots = np.diagonal(own, axis1=1, axis2=2) / np.diagonal(information, axis1=1, axis2=2)
        if (pivots > SURE).all():
            return
    except np.linalg.LinAlgError:
        pass
    check_information(information, _hinted(fault))


def _hinted(fault: Fault) -> Fault:
    hint = '; repair="clip" (--repair clip) would clip its eigenvalues'
    return lambda row, text: fault(row, text + hint)
