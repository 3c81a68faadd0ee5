"""`pcm-jax stream`: a line whenever the answer changes, and at the end that of the batch."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
import time

import numpy as np
import pytest

from pcm_jax.cli.stream import in_order
from pcm_jax.errors import InputError
from pcm_jax.files import read_graph, write_g2o
from pcm_jax.online import IncrementalPcm
from pcm_jax.pipeline import select


def lines_of(ran):
    assert (ran.status, ran.err) == (0, "")
    return [json.loads(line) for line in ran.out.splitlines()]


def test_ends_with_the_batch_answer(run, city, tmp_path):
    ran = run("stream", city / "graph.g2o", "--json", "--save", tmp_path / "state.npz")
    *changes, end = lines_of(ran)
    graph = read_graph(city / "graph.g2o")
    batch = select(graph)
    believed = set()
    for line in changes:
        assert line["event"] == "changed"
        believed |= {one["source"] for one in line["entered"]}
        believed -= {one["source"] for one in line["left"]}
        assert len(believed) == line["accepted"]
    assert believed == set(graph.closures.source[batch.accepted])
    assert (end["event"], end["closures"]) == ("end", len(graph.closures))
    assert end["robot_pairs"][0]["why"] == batch.pairs[0].verdict.why
    state = IncrementalPcm.load(tmp_path / "state.npz")
    np.testing.assert_array_equal(state.result().accepted, batch.accepted)


def test_says_it_in_words(run, city):
    every = run("stream", city / "graph.g2o", "--minimum-inliers", "2").out.splitlines()
    last = run("stream", city / "graph.g2o", "--minimum-inliers", "2", "--every", "99")
    assert every[0].startswith("3 closures, 2 believed (+2 −0): a-b 2 of 3") or len(every) > 3
    changed, end, why = last.out.splitlines()
    assert changed.startswith("20 closures, 6 believed (+6 −0): a-b 6 of 20")
    assert end == "end: 20 closures, 6 believed: a-b 6 of 20"
    assert why == "  a-b: 6 of 20 closures found that agree, 2 asked for"


def test_closures_come_with_the_later_of_their_poses(city):
    graph = read_graph(city / "graph.g2o")
    closures = graph.closures
    assert in_order(graph, "auto") is closures
    with pytest.raises(InputError, match=r"pose a.* of closure 0 has no time"):
        in_order(graph, "stamps")
    stamped = [
        dataclasses.replace(one, stamps=np.arange(one.num_poses) * step)
        for one, step in zip(graph.maps, (1.0, 3.0), strict=True)
    ]
    found = in_order(dataclasses.replace(graph, maps=tuple(stamped)), "auto")
    times = np.maximum(np.asarray(found.pose_a), 3.0 * np.asarray(found.pose_b))
    assert (np.diff(times) >= 0.0).all() and len(found) == len(closures)
    lines = in_order(dataclasses.replace(graph, maps=tuple(stamped)), "lines")
    assert lines is closures


@pytest.mark.slow
def test_follows_a_file_that_grows(city, tmp_path):
    graph = read_graph(city / "graph.g2o")
    path = tmp_path / "growing.g2o"
    write_g2o(path, dataclasses.replace(graph, closures=graph.closures[:8]))
    rest = (city / "graph.g2o").read_text()
    options = ["--json", "--follow", "--patience", "8"]
    command = [sys.executable, "-m", "pcm_jax", "stream", str(path), *options]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        time.sleep(4.0)
        path.write_text(rest)
        out, _ = process.communicate(timeout=100)
    *_, end = map(json.loads, out.splitlines())
    assert process.returncode == 0
    assert end["closures"] == len(graph.closures)
    assert end["accepted"] == int(select(graph).accepted.sum())


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--every", "0"], "--every: 0 given, expected at least 1"),
        (["--patience", "3"], "--patience: given without --follow"),
        (["--follow", "--patience", "-1"], "--patience: -1.0 given"),
        (["--minimum-inliers", "few"], "'few', expected chance or a number"),
        (["--order", "stamps"], "--order: stamps given, but pose a"),
        (["--confidence", "1.5"], "confidence: 1.5; expected"),
        (["--save", "/nowhere/state.npz"], "/nowhere"),
    ],
)
def test_bad_options(run, city, options, words):
    ran = run("stream", city / "graph.g2o", *options)
    assert ran.status == 2
    assert ran.err.startswith("error: ") and ran.err.count("\n") == 1
    assert words in ran.err
