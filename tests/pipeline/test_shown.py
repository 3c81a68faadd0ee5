"""How results show themselves in a notebook: as their repr above a table."""

import re

import numpy as np
import pytest

import pcm_jax
from pcm_jax.simulation import simulate_city


@pytest.fixture(scope="module")
def graph():
    return simulate_city(seed=0, poses=60, inliers=8, aliased_groups=0, random=10).graph


@pytest.fixture(scope="module")
def result(graph):
    return pcm_jax.merge(graph)


def rows_of(shown):
    """Cells of the table, row by row, the heads first."""
    table = shown._repr_html_().partition("</pre>")[2]
    lines = re.findall(r"<tr>(.*?)</tr>", table)
    return [re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", line) for line in lines]


def test_evidence_has_a_row_for_each_pair_of_robots(result):
    heads, row = rows_of(result.selection.evidence)
    assert heads == ["robots", "closures", "distances"]
    assert row == ["a – b", "18", "kept"]


def test_a_selection_says_of_each_pair_what_was_accepted_and_why(result):
    heads, row = rows_of(result.selection)
    told = dict(zip(heads, row, strict=True))
    (pair,) = result.selection.pairs
    assert told["robots"] == "a – b"
    assert (told["measured"], told["accepted"]) == ("18", str(pair.accepted.sum()))
    assert told["largest set"] == "proven"
    assert told["why"] == pair.verdict.why
    assert float(told["chance p"]) == pytest.approx(pair.verdict.chance.p_value, rel=0.05)


def test_a_merge_shows_its_selection_and_its_groups(result):
    assert rows_of(result) == rows_of(result.selection)
    assert "a + b" in result._repr_html_()


def test_a_merge_by_given_closures_shows_their_number(graph, result):
    given = pcm_jax.merge(graph, accepted=result.accepted)
    assert rows_of(given) == [
        ["robots", "measured", "accepted"],
        ["a – b", "18", str(result.accepted.sum())],
    ]


def test_a_calibration_has_a_row_for_each_factor(graph, result):
    found = pcm_jax.calibrate(graph, result.accepted)
    heads, *rows = rows_of(found)
    assert heads[2:4] == ["factor on information", "90 % interval"]
    shown = [row[:2] for row in rows]
    assert shown == [[k, v] for k in ("odometry", "closures") for v in ("translation", "rotation")]
    for row, factor in zip(rows, found.factors, strict=True):
        known = row[2] != "–"
        assert known == factor.known
        if known:
            assert float(row[2]) == pytest.approx(float(factor), rel=0.01)
            ends = [float(end) for end in row[3].split(" to ")]
            np.testing.assert_allclose(ends, factor.interval, rtol=0.01)
            assert row[4].startswith("errors are")
