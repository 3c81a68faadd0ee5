"""The table, the baseline, and the results in the README."""

import json

import pytest

from benchmarks.suite import report
from benchmarks.suite.harness import Case, Measured, Metric, Outcome

MACHINE = {
    "processor": "abacus",
    "cores": 2,
    "memory_gb": 1.0,
    "python": "3",
    "packages": {"jax": "1"},
    "blas_threads": "2",
    "load_at_start": 0.0,
    "commit": "abc",
    "date": "2000-01-01",
}


def entries_of(value, baseline=None, **options):
    case = Case("a/b", (Metric("c", "s", **options),), lambda settings: {})
    outcomes = {"a/b": Outcome({"c": Measured(value, "how")}, 1.0, 2.0)}
    return report.summary([case], outcomes, {"a/b/c": {"value": baseline}} if baseline else {})


@pytest.mark.parametrize(
    ("value", "options", "change"),
    [
        (1.4, {}, "same"),
        (1.6, {}, "worse"),
        (0.6, {}, "better"),
        (1.6, {"direction": "higher"}, "better"),
        (0.6, {"direction": "higher"}, "worse"),
        (1.6, {"direction": "target"}, "changed"),
        (1.6, {"tolerance": 1.0}, "same"),
        (1.6, {"tolerance": None}, None),
        (None, {}, None),
    ],
)
def test_change_against_the_baseline(value, options, change):
    assert entries_of(value, 1.0, **options)["a/b/c"]["change"] == change


def test_table():
    text = report.table(entries_of(0.51234, 0.5, figure=0.4) | {"d": entries_of(None)["a/b/c"]})
    lines = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines()]
    assert lines[0] == list(report.HEAD)
    assert lines[2] == ["a/b/c", "0.512 s", "≤ 0.4 s", "**no**", "1.02 same", "2", "how"]
    assert lines[3] == ["d", "–", "", "", "", "", "how"]
    assert len({len(line) for line in text.splitlines()}) == 1
    assert "of baseline" not in report.table(entries_of(0.5))


def test_recorded_results_are_the_baseline_and_stand_in_the_readme(tmp_path, monkeypatch):
    document = report.README.read_text()
    monkeypatch.setattr(report, "BASELINE", tmp_path / "baseline.json")
    monkeypatch.setattr(report, "README", tmp_path / "README.md")
    report.README.write_text(document)
    entries = entries_of(0.5) | {"a/b/absent": entries_of(None)["a/b/c"]}
    for _ in range(2):  # the second time replaces the first
        report.record(entries, MACHINE)
        text = report.README.read_text()
        assert text.count(report.table(entries)) == 1
        assert "abacus, 2 cores" in text
        assert "Run time: a 1 s" in text
    before, after = (document.split(marker) for marker in report.MARKERS)
    assert text.startswith(before[0])
    assert text.endswith(after[1])
    assert report.read_baseline(report.BASELINE) == {
        "a/b/c": {"value": 0.5, "unit": "s", "direction": "lower", "tolerance": 0.5}
    }
    assert json.loads(report.BASELINE.read_text())["machine"] == MACHINE
    assert report.read_baseline(tmp_path / "none.json") == {}
