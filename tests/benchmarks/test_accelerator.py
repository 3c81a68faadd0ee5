"""`python -m benchmarks.accelerator` on the CPU: parts run, and their answers are checked."""

import json
from types import SimpleNamespace

import jax
import pytest

from benchmarks import accelerator
from benchmarks.suite.measure import Patience


@pytest.mark.slow
def test_all_but_the_sweep_runs_on_the_cpu(tmp_path, monkeypatch):
    monkeypatch.setattr(accelerator, "PATIENCE", Patience(1, 0.0))
    monkeypatch.setattr(accelerator, "DEFINITION", 24)
    arguments = ["--sizes", "64", "--poses", "120", "--graphs", "16", "--worlds", "0"]
    assert accelerator.main([*arguments, "--out", str(tmp_path)]) == 0
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert list(summary) == [
        "merge",
        "definition, float64",
        "cliques, 16 graphs",
        "Q, m = 64, float64",
        "Q, m = 64, float32",
    ]
    assert all(part["difference"] == 0.0 for part in summary.values())
    assert "cpu" in json.loads((tmp_path / "run.json").read_text())["options"]["device"]


def test_a_part_that_does_not_fit_is_left_out(tmp_path, monkeypatch):
    def too_large(*_):
        raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory")

    parts = [("a", too_large), ("b", lambda: {"device": 1.0})]
    monkeypatch.setattr(accelerator, "_parts", lambda *_: iter(parts))
    found = dict(accelerator._measured(SimpleNamespace(minutes=9e9), None, 0.0))
    assert found == {"a": {"left_out": "more memory than there is"}, "b": {"device": 1.0}}
    late = dict(accelerator._measured(SimpleNamespace(minutes=0.0), None, 0.0))
    assert all(part["left_out"].startswith("after") for part in late.values())


def test_another_answer_is_refused():
    with pytest.raises(RuntimeError, match=r"differs by 1e-05, expected at most 1e-09"):
        accelerator._figures({"fast": 1.0, "cpu": 2.0}, 1, 1e-5, 1e-9)
