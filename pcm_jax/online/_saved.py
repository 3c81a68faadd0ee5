"""The whole state in one file, and back: arrays and JSON in an `.npz`, without pickle.

`meta` holds JSON with the version, the options and a digest of all the rest; a file that was cut
short or changed is refused. It is written whole or not at all (`store.written_whole`).
"""

from __future__ import annotations

import dataclasses
import json
import struct
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import jaxlie
import numpy as np

from pcm_jax import lie
from pcm_jax.clique import GrowingClique
from pcm_jax.errors import FileFormatError, InputError
from pcm_jax.graph import LoopClosures, MultiRobotGraph, PoseGraph, Priors
from pcm_jax.mapping import MapCovariance
from pcm_jax.online._arrivals import Arrived
from pcm_jax.online._pair import HeldPair
from pcm_jax.online._state import State
from pcm_jax.store import digest, written_whole

VERSION = 2
Arrays = dict[str, np.ndarray]
# What Python's modules raise for an archive that is none, was cut short or changed.
BROKEN = (
    *(ValueError, KeyError, TypeError, AttributeError, RuntimeError, OSError, EOFError),
    *(MemoryError, zipfile.BadZipFile, zlib.error, struct.error),
)
MEASURED = ("robot_a", "pose_a", "robot_b", "pose_b", "information", "weight")


def write(path: Path, meta: dict[str, Any], arrays: Arrays) -> None:
    """Writes arrays and what JSON can hold, whole or not at all.

    Raises:
        InputError: for an option that JSON has no form for.
    """
    told = {"version": VERSION, **meta, "digest": _digest(meta, arrays)}
    text = np.frombuffer(json.dumps(told, allow_nan=False).encode(), np.uint8)
    with written_whole(path) as unfinished, unfinished.open("wb") as file:
        np.savez(file, allow_pickle=False, meta=text, **arrays)  # type: ignore[arg-type]


def read(path: Path, form: str) -> tuple[dict[str, Any], Arrays]:
    """Reads what `write` wrote.

    Args:
        path: of the file.
        form: whose state it is, `meta["form"]`.

    Raises:
        FileFormatError: for a file of another kind or version, one that is cut short or changed.
        OSError: for one that cannot be opened.
    """
    with path.open("rb") as opened:
        try:
            with np.load(opened, allow_pickle=False) as file:
                arrays = {name: file[name] for name in file.files}
            meta = json.loads(arrays.pop("meta").tobytes())
            version, found = meta.pop("version"), meta.pop("digest")
        except BROKEN as error:
            raise FileFormatError(path, None, f"not a state that {form} saved") from error
    if version != VERSION:
        raise FileFormatError(path, None, f"version {version!r}, expected {VERSION}")
    if found != _digest(meta, arrays):
        raise FileFormatError(path, None, "changed since it was written, or cut short")
    if meta.get("form", form) != form:
        raise FileFormatError(path, None, f"a state of {meta['form']}, expected one of {form}")
    return meta, arrays


def _digest(meta: dict[str, Any], arrays: Arrays) -> str:
    named = [part for name in sorted(arrays) for part in (name, arrays[name])]
    return digest(json.dumps(meta, sort_keys=True, allow_nan=False), *named)


def options_to_save(options: Mapping[str, Any]) -> dict[str, Any]:
    """The options as JSON has them, without `progress`.

    Raises:
        InputError: for a function.
    """
    kept = {name: value for name, value in options.items() if name != "progress"}
    for name, value in kept.items():
        if callable(value):
            raise InputError(f"{name}: a function given, expected a name for a state to be saved")
    return {
        name: value.item() if isinstance(value, np.generic) else value
        for name, value in kept.items()
    }


def arrays_of(state: State) -> Arrays:
    """The state as arrays by name."""
    found: Arrays = {}
    for index, (one, covariance) in enumerate(zip(state.maps.maps, state.covariances, strict=True)):
        found |= prefixed(f"map{index}", map_arrays(one))
        placed = np.asarray(lie.parameters(lie.as_numpy(covariance.pose_graph.poses)))
        found |= {f"map{index}.optimum": placed, f"map{index}.origin": covariance.origin}
    found |= prefixed("held", closure_arrays(state.arrived.closures))
    found |= prefixed("waiting", closure_arrays(state.waiting))
    for (a, b), pair in state.pairs.items():
        found[f"believed{a}-{b}"] = pair.believed
        if pair.clique is not None:
            found[f"pair{a}-{b}"] = np.packbits(pair.clique.dense(), axis=1)
    return found


def state_of(arrays: Arrays, meta: Mapping[str, Any], weighing: tuple[float, float, Any]) -> State:
    """The state that `arrays_of` gave."""
    maps, covariances = [], []
    for index, name in enumerate(meta["robots"]):
        own = those_of(f"map{index}", arrays)
        given = map_of(own, name)
        maps.append(given)
        optimum = given.with_poses(given.group(own["optimum"]))
        covariances.append(MapCovariance(optimum, origin=own["origin"]))
    group = maps[0].group
    held = closures_of(those_of("held", arrays), group)
    state = dataclasses.replace(
        State.of_maps(MultiRobotGraph(tuple(maps)), tuple(covariances), weighing),
        arrived=Arrived(held),
        waiting=closures_of(those_of("waiting", arrays), group),
        repeated=meta["repeated"],
    )
    return dataclasses.replace(state, pairs=dict(_pairs(state, held, arrays)))


def _pairs(
    state: State, held: LoopClosures, arrays: Arrays
) -> Iterator[tuple[tuple[int, int], HeldPair]]:
    for a, b in held.pairs():
        measured, indices = held.between(a, b)
        both = state.covariances[a], state.covariances[b]
        packed = arrays[f"pair{a}-{b}"]
        dense = np.unpackbits(packed, axis=1, count=len(packed)).view(np.bool_)
        pair = HeldPair((a, b), both, *state.weighing)
        pair.add(measured, indices, GrowingClique.of_graph(dense))
        pair.believed = arrays[f"believed{a}-{b}"]
        yield (a, b), pair


def map_arrays(one: PoseGraph) -> Arrays:
    """A map as arrays by name; its own name is not among them."""
    found = {
        "poses": np.asarray(lie.parameters(lie.as_numpy(one.poses))),
        "tail": np.asarray(one.tail),
        "head": np.asarray(one.head),
        "measurement": np.asarray(lie.parameters(lie.as_numpy(one.measurement))),
        "information": np.asarray(one.information),
        "ids": one.ids,
        "source": one.source.astype(str),
    }
    if one.stamps is not None:
        found["stamps"] = one.stamps
    if one.priors is not None:
        found |= {
            "priors.pose": np.asarray(one.priors.pose),
            "priors.measurement": np.asarray(lie.parameters(one.priors.measurement)),
            "priors.information": np.asarray(one.priors.information),
            "priors.source": one.priors.source.astype(str),
        }
    return found


def map_of(own: Arrays, name: str) -> PoseGraph:
    """The map that `map_arrays` gave."""
    group, priors = _group(own["information"].shape[-1]), None
    if "priors.pose" in own:
        priors = Priors(
            own["priors.pose"],
            group(own["priors.measurement"]),
            own["priors.information"],
            own["priors.source"].astype(object),
        )
    return PoseGraph.from_checked(
        poses=group(own["poses"]),
        tail=own["tail"],
        head=own["head"],
        measurement=group(own["measurement"]),
        information=own["information"],
        ids=own["ids"],
        name=name,
        source=own["source"].astype(object),
        stamps=own.get("stamps"),
        priors=priors,
    )


def closure_arrays(closures: LoopClosures) -> Arrays:
    """Closures as arrays by name."""
    found = {name: np.asarray(getattr(closures, name)) for name in MEASURED}
    found["measurement"] = np.asarray(lie.parameters(lie.as_numpy(closures.measurement)))
    found["source"] = closures.source.astype(str)
    return found if closures.is_true is None else {**found, "is_true": closures.is_true}


def closures_of(own: Arrays, group: Any) -> LoopClosures:
    """The closures that `closure_arrays` gave."""
    return LoopClosures.from_checked(
        tuple(own[name] for name in MEASURED[:4]),
        group(own["measurement"]),
        own["information"],
        own["source"].astype(object),
        own["weight"],
        own.get("is_true"),
    )


def _group(d: int) -> Any:
    return jaxlie.SE2 if d == 3 else jaxlie.SE3


def prefixed(prefix: str, arrays: Arrays) -> Arrays:
    """The arrays by names that begin so."""
    return {f"{prefix}.{name}": array for name, array in arrays.items()}


def those_of(prefix: str, arrays: Arrays) -> Arrays:
    """The arrays that `prefixed` gave, by their own names."""
    start = f"{prefix}."
    return {
        name.removeprefix(start): array for name, array in arrays.items() if name.startswith(start)
    }
