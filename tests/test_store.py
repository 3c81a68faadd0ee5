"""Results kept on disk: what is read again, what is computed anew, what a kill leaves behind."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from pcm_jax.store import Store, digest, write_json, written_whole


def test_a_result_is_computed_once_for_the_same_options_and_sources(tmp_path):
    source = tmp_path / "source.py"
    source.write_text("x = 1\n")
    counter = itertools.count()

    def result(options: str, name: str = "one") -> int:
        store = Store(tmp_path / "steps", digest(options, files=[source]))
        return store(name, lambda: {"value": next(counter)})["value"]

    assert [result("a"), result("a"), result("a", "two"), result("a")] == [0, 0, 1, 0]
    assert [result("b"), result("b")] == [2, 2]
    source.write_text("x = 2\n")
    assert [result("b"), result("b")] == [3, 3]
    (tmp_path / "steps" / "one.json").write_text('{"stamp": ')  # killed while it was written
    assert result("b") == 4
    (tmp_path / "steps" / "one.json").write_text("[]")  # another program's
    assert result("b") == 5


def test_results_are_returned_as_they_will_be_read(tmp_path):
    computed = {"pair": (1, 2)}
    assert Store(tmp_path, "s")("one", lambda: computed) == {"pair": [1, 2]}
    assert Store(None, "s")("one", lambda: computed) is computed


def test_arrays_of_several_stamps_lie_side_by_side(tmp_path):
    first, second = Store(tmp_path, "a"), Store(tmp_path, "b")
    first.write_array("panel", np.arange(6).reshape(2, 3))
    assert second.read_array("panel") is None
    second.write_array("panel", np.zeros(2))
    np.testing.assert_array_equal(first.read_array("panel"), [[0, 1, 2], [3, 4, 5]])
    (whole,) = tmp_path.glob("a-*")
    whole.write_bytes(whole.read_bytes()[:-1])
    assert first.read_array("panel") is None
    Store(None, "a").write_array("panel", np.zeros(2))
    assert Store(None, "a").read_array("panel") is None


def test_a_file_is_written_whole_or_not_at_all(tmp_path):
    path = tmp_path / "file.json"
    write_json(path, {"is": "whole"})
    with pytest.raises(ValueError, match="JSON"):
        write_json(path, float("nan"))
    with pytest.raises(RuntimeError), written_whole(path) as unfinished:
        unfinished.write_text("half")
        assert unfinished.name.startswith(".")
        raise RuntimeError
    assert [each.name for each in tmp_path.iterdir()] == ["file.json"]
    assert path.read_text() == '{\n  "is": "whole"\n}\n'


def test_stamps_tell_values_shapes_types_and_files_apart(tmp_path):
    (tmp_path / "a.py").write_text("x")
    (tmp_path / "b.txt").write_text("x")
    zeros = np.zeros(4)
    stamps = [
        digest(),
        digest(1),
        digest("1"),
        digest(zeros),
        digest(zeros.reshape(2, 2)),
        digest(zeros.astype(np.int64)),
        digest(files=[tmp_path]),
        digest(files=[tmp_path, tmp_path / "b.txt"]),
    ]
    assert len(set(stamps)) == len(stamps)
    assert digest(zeros) == digest(np.zeros((4, 2))[:, 0])  # layout is no difference
