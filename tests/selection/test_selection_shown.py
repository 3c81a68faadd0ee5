"""A selection as people see it."""

from __future__ import annotations

import numpy as np
import pytest

import pcm_jax as pcm
from pcm_jax.simulation import simulate_city


@pytest.fixture(scope="module")
def selection():
    graph = simulate_city(seed=1, poses=30, inliers=6, random=8).graph
    return pcm.select(graph, minimum_inliers=4)


def test_in_three_lines(selection):
    count, gate = int(selection.accepted.sum()), selection.gate
    assert count >= 4
    assert repr(selection).splitlines() == [
        f"Selection({count} of {len(selection.accepted)} closures accepted)",
        f"  pairs   a-b {count} of {len(selection.accepted)}",
        f"  method  pcm-exact, confidence 0.99, gate {gate:.4g}",
    ]


def test_as_a_table(selection):
    heads, rows = selection._table()
    (row,) = (dict(zip(heads, row, strict=True)) for row in rows)
    assert row["robots"] == "a – b"
    assert row["measured"] == len(selection.accepted)
    assert row["accepted"] == selection.accepted.sum()
    assert row["largest set"] == "proven"


def test_a_pair_gives_its_evidence(selection):
    (pair,) = selection.pairs
    assert (pair.robot_a, pair.robot_b) == (0, 1)
    assert pair.consistent()[np.ix_(pair.accepted, pair.accepted)].sum() == (
        pair.accepted.sum() * (pair.accepted.sum() - 1)
    )
    np.testing.assert_array_equal(pair.squared <= pair.gate, pair.evidence.squared <= pair.gate)
    assert repr(pair).startswith("PairSelection(")
