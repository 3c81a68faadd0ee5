"""The triage is silent in worlds that are written as they are meant; 200 of them by the command."""

import json

import pytest

from benchmarks import silence


@pytest.mark.slow
def test_a_few_worlds_of_either_group(tmp_path):
    assert silence.main(["--worlds", "6", "--out", str(tmp_path)]) == 0
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert list(summary) == ["SE2", "SE3"]
    for found in summary.values():
        assert (found["worlds"], found["named"], found["findings"]) == (6, 0, {})


def test_what_is_named_is_counted(monkeypatch):
    """A triage that always speaks is heard in every world."""

    class Loud:
        sentence = "inverted"

    monkeypatch.setattr(silence, "triage", lambda evidence, gate: Loud)
    monkeypatch.setattr(silence, "weigh", lambda graph: graph)
    found = silence._named("SE2", 2)
    assert (found["named"], found["findings"]) == (2, {"0": "inverted", "1": "inverted"})


def test_worlds_are_cluttered_and_differ():
    counts = {len(silence.cluttered_world("SE2", seed).closures) for seed in range(6)}
    assert len(counts) > 3


def test_a_group_that_is_done_is_not_done_again(monkeypatch, tmp_path):
    monkeypatch.setattr(silence, "_named", lambda group, worlds: {"worlds": worlds, "named": 0})
    arguments = ["--worlds", "3", "--out", str(tmp_path)]
    assert silence.main(arguments) == 0
    monkeypatch.delattr(silence, "_named")
    assert silence.main(arguments) == 0
