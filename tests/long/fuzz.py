"""Fuzzing of every reader: valid files of every format, changed in a few places.

    python -m tests.long.fuzz --count 1000000 --minutes 10

A reader may give a result, or an `InputError` of one line that names the file. Anything else is
found: another exception, a warning that is not ours, more than a second, memory past the bound. A
g2o file that is accepted and plain must mean what `_g2o_oracle` reads. Every input follows from
the seed and its number, so one that was found is made again by `--only NUMBER`; not those of saved
states and reports, which hold the seconds that they took.
"""

from __future__ import annotations

import argparse
import gzip
import io
import lzma
import random
import resource
import signal
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np

from pcm_jax import lie
from pcm_jax.cli import main as main_of_pcm
from pcm_jax.errors import InputError, InputWarning
from pcm_jax.files import read_graph
from pcm_jax.online import IncrementalPcm

from ._g2o_oracle import strict
from ._log import LOGS, commit, found_in, machine, table
from ._seeds import Seed, binaries, texts, write_team

SECONDS, HUNG, BYTES = 1.0, 20, 2 << 30
BAGS, SELDOM = ("one.bag", "two.mcap"), 0.1  # they take fifty milliseconds, mostly not ours
WORDS = (
    *("nan", "-nan", "inf", "-inf", "1e400", "-1e400", "1e308", "1e-308", "1e99", "1e15", "1e16"),
    *(
        "0",
        "-0",
        "-1",
        "1",
        "2",
        "3",
        "0.5",
        "1_0",
        "0x10",
        "1e",
        "+1",
        "1.",
        ".5",
        "1,5",
        "١",
        "２",
    ),
    *("9223372036854775807", "9223372036854775808", "18446744073709551615", "9" * 400),
    *("a", "a0", "#", "", '"', "'", "\\", "\x00", "\u2028", "\ufeff", "\udcff", "<script>", "true"),
    *(
        "VERTEX_SE2",
        "EDGE_SE2",
        "VERTEX_SE3:QUAT",
        "EDGE_SE3:QUAT",
        "EDGE2",
        "EDGE3",
        "FIX",
        "null",
    ),
    *("[]", "{}", "[[[[", "]", "}", ":", "NaN", "Infinity", "1e9999", "7061644061714939904"),
)
OPTIONS: list[dict[str, Any]] = [
    {},
    {},
    {"information": "sqrt"},
    {"information": "covariance"},
    {"rotation_information": "quaternion"},
    {"repair": "clip"},
    {"default_sigmas": (0.1, 0.01)},
    {"ignore_priors": True},
    *({"ids": rule} for rule in ("per-file", "shared", "symbols")),
]


def mutated(seed: Seed, others: list[Seed], rng: random.Random) -> bytes:
    """One to four changes to a file's bytes, lines and words; now and then compressed and cut."""
    data = seed.data
    textual = b"\x00" not in data
    for _ in range(rng.choice((1, 1, 1, 2, 2, 3, 4))):
        if textual and rng.random() < 0.8:
            data = _lines_changed(data, others, rng)
        else:
            data = _bytes_changed(data, rng)
    if rng.random() < 0.05:
        data = gzip.compress(data, 1) if rng.random() < 0.5 else lzma.compress(data, preset=0)
        data = _bytes_changed(data, rng) if rng.random() < 0.8 else data
    return data


def _bytes_changed(data: bytes, rng: random.Random) -> bytes:
    start = rng.randrange(len(data) + 1)
    end = min(len(data), start + rng.choice((1, 1, 2, 4, 8, 64)))
    part = data[start:end]
    return (
        data[:start]
        + rng.choice(
            (
                b"",  # lost
                part + part,
                bytes(byte ^ (1 << rng.randrange(8)) for byte in part),
                rng.randbytes(len(part)),
                rng.choice((b"\x00", b"\xff", b"\x7f")) * len(part),
                rng.randbytes(rng.choice((1, 4))) + part,
            )
        )
        + data[end if rng.random() < 0.9 else len(data) :]  # or cut short
    )


def _lines_changed(data: bytes, others: list[Seed], rng: random.Random) -> bytes:
    lines = data.split(b"\n")
    at, other = rng.randrange(len(lines)), rng.randrange(len(lines))
    match rng.randrange(8):
        case 0:
            del lines[at]
        case 1:
            lines.insert(other, lines[at])
        case 2:
            lines[at], lines[other] = lines[other], lines[at]
        case 3:
            lines[at : at + 2] = [rng.choice((b"", b" ", b",")).join(lines[at : at + 2])]
        case 4:
            foreign = rng.choice(others).data.split(b"\n")
            lines.insert(at, rng.choice(foreign))
        case _:
            lines[at] = _words_changed(lines[at], rng)
    return rng.choice((b"\n", b"\n", b"\n", b"\n", b"\r\n", b"\r")).join(lines)


def _words_changed(line: bytes, rng: random.Random) -> bytes:
    apart = next((mark for mark in (b", ", b",", b" ") if mark in line), b" ")
    words = line.split(apart)
    at, other = rng.randrange(len(words)), rng.randrange(len(words))
    match rng.randrange(8):
        case 0:
            words[at], words[other] = words[other], words[at]
        case 3 | 4:
            words[at] = rng.choice((f"{rng.gauss(0, 3):.3g}", str(rng.randrange(5)))).encode()
        case 1:
            del words[at]
        case 2:
            words.insert(at, words[other])
        case _:
            words[at] = rng.choice(WORDS).encode("utf-8", "surrogatepass")
    return apart.join(words)


class Readers:
    """What reads each seed, by its kind, from a folder that holds valid maps beside it."""

    def __init__(self, folder: Path):
        (folder / "maps").mkdir()
        self.maps = write_team(folder / "maps")[:2]

    def __call__(self, seed: Seed, path: Path, options: dict[str, Any]) -> Any:
        if seed.reader == "closures":
            return read_graph(*self.maps, closures=path, **options)
        if seed.reader == "steps":
            return read_graph(path, **{"default_sigmas": (0.1, 0.01), **options})
        if seed.reader == "state":
            return IncrementalPcm.load(path)
        if seed.reader == "report":
            return _explained(path)
        return read_graph(path, **options)


def _explained(path: Path) -> str:
    """What the command line says of a report's first closure, or its error."""
    with redirect_stdout(io.StringIO()) as told, redirect_stderr(io.StringIO()) as errors:
        status = main_of_pcm(["explain", str(path), "0"])
    if status:
        raise InputError(errors.getvalue().removesuffix("\n"))
    return told.getvalue()


def fault(read: Callable[[], Any], path: Path) -> tuple[str | None, Any]:
    """What is wrong with how a reader takes a file, or None, and the result if there is one."""
    began = time.perf_counter()
    result = None
    try:
        result = read()
    except InputError as error:
        if "\n" in str(error) or str(path.parent) not in str(error):
            return f"a message that is not one line with the file: {error}", None
    except Exception as error:
        trace = error.__traceback__
        while trace and trace.tb_next:
            trace = trace.tb_next
        where = f"{Path(trace.tb_frame.f_code.co_filename).name}:{trace.tb_lineno}" if trace else ""
        return f"{type(error).__name__}: {str(error)[:150]} ({where})", None
    seconds = time.perf_counter() - began
    return (f"{seconds:.1f} s" if seconds > SECONDS else None), result


def verdict(
    readers: Readers, seed: Seed, path: Path, data: bytes, options: dict[str, Any]
) -> tuple[str | None, bool, bool]:
    """What is wrong with how an input is taken; and whether it is accepted, and was compared."""
    path.write_bytes(data)
    signal.alarm(HUNG)
    wrong, result = fault(lambda: readers(seed, path, options), path)
    signal.alarm(0)
    plain = False
    if wrong is None and result is not None and seed.name.endswith(".g2o") and not options:
        plain, wrong = difference(result, data)
    return wrong, result is not None, plain


def difference(graph: Any, data: bytes) -> tuple[bool, str | None]:
    """Whether a g2o file is plain, and how what was read of it differs from the strict reader's."""
    try:
        text = data.decode("ascii")
    except UnicodeDecodeError:
        return False, None
    meant = strict(text)
    if meant is None or len({tuple(row) for row in meant[1]}) < len(meant[1]):
        return False, None  # edges that are stated twice may count once
    ids = {int(one) for part in graph.maps for one in part.ids}
    rows = [row for part in graph.maps for row in _rows(part.ids, part.ids, part)]
    closures = graph.closures
    for k in range(len(closures)):
        a, b = (graph.maps[int(one[k])] for one in (closures.robot_a, closures.robot_b))
        i, j = int(closures.pose_a[k]), int(closures.pose_b[k])
        rows += _rows(a.ids[[i]], b.ids[[j]], closures[[k]], 0, 0)
    if ids != meant[0] | {int(end) for row in meant[1] for end in row[:2]}:
        return True, f"other poses: {sorted(ids ^ meant[0])[:5]}"
    first, second = sorted(rows, key=_order), sorted(meant[1], key=_order)
    if len(first) != len(second):
        return True, f"{len(first)} edges, {len(second)} meant"
    for one, other in zip(first, second, strict=True):
        gap = np.abs((one - other).astype(float)) / np.maximum(1, np.abs(other.astype(float)))
        if not (gap < 1e-9).all():
            return True, f"{one} read, {other} meant"
    return True, None


def _order(row: np.ndarray) -> tuple:
    return tuple(int(end) for end in row[:2]), tuple(np.round(row[2:].astype(float), 6))


def _rows(ids_a: Any, ids_b: Any, edges: Any, *ends: int) -> list[np.ndarray]:
    """The edges of a map, or one closure, as the strict reader has them."""
    numbers = np.asarray(lie.parameters(lie.as_numpy(edges.measurement)))
    flat = numbers.shape[1] == 4
    tail, head = ends or (edges.tail, edges.head)
    found = []
    triangle = np.triu_indices(3 if flat else 6)
    for k, row in enumerate(numbers):
        a, b = np.atleast_1d(tail)[k], np.atleast_1d(head)[k]
        if flat:
            motion = [row[2], row[3], np.arctan2(row[1], row[0])]
        else:
            motion = [*row[4:], *(row[[1, 2, 3, 0]] * (1 if row[0] >= 0 else -1))]
        information = np.asarray(edges.information)[k][triangle]
        found.append(np.array([int(ids_a[a]), int(ids_b[b]), *motion, *information], object))
    return found


class HungError(Exception):
    """A reader that took longer than any reader may."""


def hung(*_: object) -> None:
    """Ends a reader by an exception, when its alarm comes."""
    raise HungError(f"more than {HUNG} s")


def run(numbers: range, seed: int, deadline: float, keep: Path | None = None) -> dict[str, Any]:
    """Tries inputs by their numbers until the deadline; gives counts and findings."""
    told: Counter[str] = Counter()
    by_format: Counter[str] = Counter()
    found: dict[str, list[int]] = {}
    signal.signal(signal.SIGALRM, hung)
    began = time.perf_counter()
    with tempfile.TemporaryDirectory(prefix="fuzz-") as place, warnings.catch_warnings():
        folder = Path(place)
        (folder / "seeds").mkdir()
        warnings.simplefilter("ignore")
        seeds = [*texts(), *binaries(folder / "seeds")]
        weights = [SELDOM if one.name in BAGS else 1.0 for one in seeds]
        readers = Readers(folder)
        warnings.simplefilter("error")
        warnings.simplefilter("ignore", InputWarning)
        held = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        for number in numbers:
            if time.monotonic() > deadline:
                break
            rng = random.Random(f"{seed} {number}")
            (one,) = rng.choices(seeds, weights)
            data = mutated(one, seeds, rng)
            options = rng.choice(OPTIONS) if rng.random() < 0.3 else {}
            if keep:
                (keep / one.name).write_bytes(data)
            wrong, accepted, plain = verdict(readers, one, folder / one.name, data, options)
            told.update(tried=1, accepted=accepted, compared=plain)
            by_format[one.name] += 1
            if wrong is not None:
                kind = f"{one.name}: {wrong}".replace(str(folder), "")
                found.setdefault(kind.splitlines()[0], []).append(number)
        grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - held
    told["grown"] = grown >> 10
    seconds = time.perf_counter() - began
    return {"told": told, "by_format": by_format, "found": found, "seconds": seconds}


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.long.fuzz", description=__doc__)
    parser.add_argument("--count", type=int, default=1_000_000)
    parser.add_argument("--first", type=int, default=0, help="number of the first input")
    parser.add_argument("--minutes", type=float, default=float("inf"))
    parser.add_argument("--seed", type=int, default=15)
    parser.add_argument("--only", type=int, help="makes one input, and keeps it here")
    parser.add_argument("--out", type=Path, default=LOGS / "fuzz.md")
    given = parser.parse_args()
    resource.setrlimit(resource.RLIMIT_DATA, (BYTES, BYTES))
    if given.only is not None:
        numbers = range(given.only, given.only + 1)
        sys.stderr.write(f"{run(numbers, given.seed, float('inf'), Path.cwd())}\n")
        return
    numbers = range(given.first, given.first + given.count)
    done = run(numbers, given.seed, time.monotonic() + 60 * given.minutes)
    told = done["told"]
    rows = [[name, count] for name, count in sorted(done["by_format"].items())]
    kinds = [f"{kind} ({len(at)} times, first {at[0]})" for kind, at in done["found"].items()]
    given.out.write_text(
        f"# Fuzzed readers\n\n`python -m tests.long.fuzz --first {given.first} --count"
        f" {told['tried']} --seed {given.seed}`: {told['tried']} inputs, {told['accepted']}"
        f" accepted, {told['compared']} of these compared with the strict reader; memory grew by"
        f" {told['grown']} MiB. Commit {commit()}; {machine()}; {done['seconds']:.0f} s.\n\n"
        + table(["seed", "inputs"], rows)
        + found_in(kinds)
    )


if __name__ == "__main__":
    main()
