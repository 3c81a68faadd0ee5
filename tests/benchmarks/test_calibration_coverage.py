"""Coverage of a calibration's intervals: worlds of known factors, and what is counted."""

import json

import numpy as np
import pytest

from benchmarks import calibration_coverage
from benchmarks.calibration_coverage import KINDS, NAMES, coverage, world
from pcm_jax.integrity.calibration import closing_edges


def test_worlds_misstate_by_the_factors_of_their_kind():
    graph, right = world(KINDS["misstated"], 3)
    honest, _ = world(KINDS["misstated"]._replace(odometry=1.0, closures=1.0), 3)
    one, closing = graph.maps[0], closing_edges(graph.maps[0])
    ratio = np.asarray(honest.maps[0].information)[:, 2, 2] / np.asarray(one.information)[:, 2, 2]
    np.testing.assert_allclose(ratio[~closing], 4.0)
    np.testing.assert_allclose(ratio[closing], 9.0)
    assert (right.sum(), (~right).sum()) == (40, 25)
    chains, _ = world(KINDS["chains"], 3)
    assert not any(closing_edges(each).any() for each in chains.maps)


@pytest.mark.slow
def test_what_is_counted(tmp_path):
    small = ["--worlds", "2", "--kinds", "one map", "--out", str(tmp_path)]
    assert calibration_coverage.main(small) == 0
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert list(summary["one map"]) == [*NAMES, "all"]
    assert summary["one map"]["all"]["worlds"] == 2
    found = coverage(KINDS["one map"], range(2))
    for name in NAMES:
        assert summary["one map"][name] == found[name]
