"""The harness on cases that take no time: own processes, faults, and going on after a kill."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import tiny_cases
from tiny_cases import LOG, METRICS, case

from benchmarks.suite import harness, report
from benchmarks.suite.harness import Measured, Metric, Settings, chosen, run
from benchmarks.suite.measure import Patience, in_words, machine, peak_memory, race


@pytest.fixture
def settings(tmp_path):
    return Settings(True, tmp_path)


def log_of(settings):
    return (settings.data / LOG).read_text().split()


def test_summary_says_for_every_metric_what_it_is_or_why_it_is_not(settings, tmp_path, capsys):
    cases = [
        case("good"),
        case("absent", tiny_cases.absent),
        case("broken", tiny_cases.broken),
        case("dying", tiny_cases.dying),
    ]
    outcomes = run(cases, settings, tmp_path / "out")
    baseline = {"tiny/good/seconds": {"value": 0.125}}
    entries = json.loads(json.dumps(report.summary(cases, outcomes, baseline), allow_nan=False))
    assert list(entries) == [f"{one.name}/{metric.name}" for one in cases for metric in METRICS]
    good = entries["tiny/good/seconds"]
    expected = {"value": 0.25, "unit": "s", "direction": "lower", "baseline": 0.125, "figure": 0.5}
    assert expected.items() <= good.items()
    assert (good["reached"], good["ratio"], good["change"]) == (True, 2.0, "worse")
    assert good["peak_memory_mb"] > 1
    assert entries["tiny/good/digits"]["reached"] is False
    reasons = {name: entry["note"] for name, entry in entries.items() if entry["value"] is None}
    assert len(reasons) == 6
    assert reasons["tiny/absent/seconds"] == "no such data"
    assert reasons["tiny/broken/digits"] == reasons["tiny/dying/digits"] == "failed"
    assert "ValueError: a fault" in outcomes["tiny/broken"].failure
    assert "code 3" in outcomes["tiny/dying"].failure
    printed = capsys.readouterr().out
    assert "[4/4] tiny/dying ..." in printed
    assert "ValueError: a fault" in printed
    described = json.loads((tmp_path / "out" / "machine.json").read_text())
    assert set(described) == {*machine(), "blas_threads"}


def test_what_is_done_is_kept_until_the_sources_change(settings, monkeypatch):
    cases = [case("one"), case("two")]
    first = run(cases, settings, settings.data)
    assert run(cases, settings, settings.data) == first
    assert log_of(settings) == ["one", "two"]
    monkeypatch.setattr(harness, "_stamp", lambda settings: "other sources")
    run(cases[:1], settings, settings.data)
    assert log_of(settings) == ["one", "two", "one"]


@pytest.mark.slow
def test_a_killed_run_goes_on_where_it_stopped(settings):
    program = [sys.executable, tiny_cases.__file__, str(settings.data)]
    killed = subprocess.run(program, capture_output=True, check=False)
    assert killed.returncode == -signal.SIGKILL
    subprocess.run(program, capture_output=True, check=True)
    log = log_of(settings)
    assert log.count("first") == log.count("last") == 1
    kept = {path.name for path in (settings.data / "cases").iterdir()}
    assert kept == {"tiny.first.json", "tiny.killing.json", "tiny.last.json"}


def test_cases_have_their_own_environment(settings, monkeypatch):
    for name in harness.ENVIRONMENT:
        monkeypatch.delenv(name, raising=False)
    before = dict(os.environ)
    probe = case("environment", tiny_cases.environment)
    assert run([probe], settings, settings.data)[probe.name].measured["seconds"].value == 1.0
    assert dict(os.environ) == before
    monkeypatch.setenv(harness.THREADS, "7")
    monkeypatch.setattr(harness, "_stamp", lambda settings: "again")
    assert run([probe], settings, settings.data)[probe.name].measured["seconds"].value == 0.0


def test_metrics_other_than_declared_are_a_fault(settings):
    odd = case("odd")._replace(metrics=METRICS[:1])
    outcome = run([odd], settings, settings.data)["tiny/odd"]
    assert "measured ['digits', 'seconds'], expected ['seconds']" in outcome.failure
    assert outcome.measured == {"seconds": Measured(None, "failed")}


def test_choice_of_cases():
    cases = [
        case("a"),
        case("slow", slow=True),
        case("stand-in", applies=lambda settings: settings.data.name == "nothing"),
    ]

    def names(only=(), **options):
        return [one.name[5:] for one in chosen(cases, Settings(**options), only)]

    assert names(data=Path("data")) == ["a", "slow"]
    assert names(data=Path("nothing")) == ["a", "slow", "stand-in"]
    assert names(quick=True) == ["a"]
    assert names(["tiny/s"], data=Path("nothing")) == ["slow", "stand-in"]


def test_race_takes_turns_until_it_has_enough():
    turns = []

    def ready(name):
        turns.append(f"ready {name}")
        return lambda: turns.append(name)

    times = race({"a": lambda: ready("a"), "b": lambda: ready("b")}, Patience(2, 0.0))
    assert turns == ["ready a", "a", "ready b", "b"] * 2
    assert times["a"].fastest <= times["a"].median <= times["a"].slowest
    assert times["b"].repeats == 2


def test_patience():
    patience = Patience(least=3, seconds=1.0, most_seconds=10.0, most=5)
    assert not patience.enough(2, 5.0)
    assert not patience.enough(3, 0.5)
    assert patience.enough(3, 1.0)
    assert patience.enough(1, 10.0)
    assert patience.enough(5, 0.0)


def test_durations_and_memory():
    assert [in_words(s) for s in (75.2, 0.0123, 4.5e-6, 2e-9)] == [
        "75.2 s",
        "12.3 ms",
        "4.5 µs",
        "2 ns",
    ]
    assert 10 < peak_memory() < 1e6


@pytest.mark.parametrize(
    ("direction", "figure", "good", "bad"),
    [
        ("lower", 2.0, 2.0, 2.1),
        ("higher", 2.0, 2.0, 1.9),
        ("target", (1.0, 2.0), 1.5, 2.1),
    ],
)
def test_figures(direction, figure, good, bad):
    metric = Metric("m", "", direction, figure)
    assert metric.reached(good) is True
    assert metric.reached(bad) is False
    assert metric.reached(None) is None
    assert Metric("m", "").reached(1.0) is None
