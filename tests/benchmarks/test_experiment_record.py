"""Steps kept on disk: what is read again, and what is computed anew."""

from __future__ import annotations

import itertools

from benchmarks.experiments.record import Steps


def test_a_step_is_computed_once_for_the_same_options_and_sources(tmp_path):
    source = tmp_path / "source.py"
    source.write_text("x = 1\n")
    counter = itertools.count()

    def result(options: str, name: str = "one") -> int:
        steps = Steps(tmp_path / "steps", options, [source])
        return steps(name, lambda: {"value": next(counter)})["value"]

    assert [result("a"), result("a"), result("a", "two"), result("a")] == [0, 0, 1, 0]
    assert [result("b"), result("b")] == [2, 2]
    source.write_text("x = 2\n")
    assert [result("b"), result("b")] == [3, 3]
    (tmp_path / "steps" / "one.json").write_text('{"stamp": ')  # killed while it was written
    assert result("b") == 4
