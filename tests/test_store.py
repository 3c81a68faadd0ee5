"""Results kept on disk: what is read again, what is computed anew, what a kill leaves behind."""

from __future__ import annotations

import itertools
import os
import stat
import sys

import numpy as np
import pytest

from pcm_jax import store
from pcm_jax.errors import FileFormatError, InputError
from pcm_jax.files import _replaced
from pcm_jax.files.output import folder_written_whole, write_text
from pcm_jax.store import Store, digest, exchange, write_json, written_whole


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


def test_a_link_stays_and_what_it_leads_to_is_replaced(tmp_path):
    (tmp_path / "far").mkdir()
    real, link = tmp_path / "far" / "real.txt", tmp_path / "link.txt"
    real.write_text("old")
    link.symlink_to(real)
    write_text(link, "new")
    assert link.is_symlink() and real.read_text() == "new"
    link.unlink()
    link.symlink_to(tmp_path / "far" / "not yet.txt")
    write_text(link, "made")
    assert link.is_symlink() and (tmp_path / "far" / "not yet.txt").read_text() == "made"
    assert sorted(each.name for each in tmp_path.rglob("*.txt")) == [
        "link.txt",
        "not yet.txt",
        "real.txt",
    ]


def test_a_file_keeps_its_mode(tmp_path):
    secret, fresh, beside = (tmp_path / name for name in ("secret", "fresh", "beside"))
    secret.write_text("old")
    secret.chmod(0o600)
    write_text(secret, "new")
    write_text(fresh, "new")
    beside.write_text("as the system makes files")
    assert secret.read_text() == "new" and stat.S_IMODE(secret.stat().st_mode) == 0o600
    assert fresh.stat().st_mode == beside.stat().st_mode


def test_no_two_writers_share_an_unfinished_file(tmp_path):
    with written_whole(tmp_path / "one") as first, written_whole(tmp_path / "one") as second:
        assert first != second
        first.write_text("1")
        second.write_text("2")
    assert [each.name for each in tmp_path.iterdir()] == ["one"]


def test_a_folder_has_its_name_once_its_files_are_there(tmp_path):
    folder = tmp_path / "maps"
    with pytest.raises(RuntimeError), folder_written_whole(folder) as place:
        write_text(place / "a", "1")
        assert not folder.exists() and place.name.startswith(".")
        raise RuntimeError
    assert not list(tmp_path.iterdir())
    with (
        pytest.raises(InputError, match=f"^{folder / 'a'}: "),
        folder_written_whole(folder) as place,
    ):
        (place / "a").mkdir()
        write_text(place / "a", "1")
    with folder_written_whole(folder) as place:
        write_text(place / "a", "1")
    assert [each.name for each in tmp_path.iterdir()] == ["maps"]
    with folder_written_whole(folder) as place:  # one that is there keeps what else is in it
        write_text(place / "b", "2")
    assert sorted(each.name for each in folder.iterdir()) == ["a", "b"]
    nowhere = folder_written_whole(tmp_path / "no" / "maps")
    with pytest.raises(FileFormatError, match="cannot be written: No such file"), nowhere:
        pass


def old_folder(place):
    folder = place / "maps"
    folder.mkdir(mode=0o750)
    for name in ("a", "b", "theirs"):
        (folder / name).write_text(f"old {name}")
    (folder / "a").chmod(0o600)
    return folder


def contents(folder):
    return {one.name: one.read_text() for one in folder.iterdir() if one.is_file()}


NEW = {"a": "new a", "b": "new b", "theirs": "old theirs"}


@pytest.mark.skipif(sys.platform != "linux", reason="folders are exchanged on Linux only")
def test_a_folder_that_is_there_is_replaced_at_once(tmp_path, monkeypatch):
    folder = old_folder(tmp_path)
    before, seen = contents(folder), []

    def seen_before_and_after(one, other):
        seen.append(contents(folder))
        (folder / "late").write_text("by another")  # while the new folder is put in its place
        (folder / "theirs").unlink()
        (folder / "theirs").write_text("changed by another")
        exchange(one, other)
        seen.append(contents(folder))

    monkeypatch.setattr(_replaced, "exchange", seen_before_and_after)
    with pytest.raises(RuntimeError), folder_written_whole(folder) as place:
        write_text(place / "a", "new a")
        raise RuntimeError
    assert contents(folder) == before and seen == []
    with folder_written_whole(folder) as place:
        write_text(place / "a", "new a")
        write_text(place / "b", "new b")
        assert contents(folder) == before
    assert seen == [before, NEW]
    theirs = {"theirs": "changed by another", "late": "by another"}
    assert contents(folder) == NEW | theirs
    assert stat.S_IMODE(folder.stat().st_mode) == 0o750
    assert stat.S_IMODE((folder / "a").stat().st_mode) == 0o600
    assert [one.name for one in tmp_path.iterdir()] == ["maps"]


def a_folder_within(folder):
    (folder / "more").mkdir()


def a_link_of_ours(folder):
    (folder / "a").rename(folder.parent / "far")
    (folder / "a").symlink_to(folder.parent / "far")


@pytest.mark.parametrize("unlike", [a_folder_within, a_link_of_ours, os.chdir, None])
def test_a_folder_that_cannot_be_exchanged_gets_finished_files(unlike, tmp_path, monkeypatch):
    folder = old_folder(tmp_path)
    before, inode = contents(folder), folder.stat().st_ino
    monkeypatch.chdir(tmp_path)
    if unlike is None:
        monkeypatch.setattr(store, "ON_LINUX", False)
    else:
        unlike(folder)
    with folder_written_whole(folder) as place:
        write_text(place / "a", "new a")
        write_text(place / "b", "new b")
        assert contents(folder) == before
    assert contents(folder) == NEW and folder.stat().st_ino == inode
    assert stat.S_IMODE((folder / "a").stat().st_mode) == 0o600
    assert (folder / "a").is_symlink() == (unlike is a_link_of_ours)
    assert not [one for one in (*tmp_path.iterdir(), *folder.iterdir()) if one.name[0] == "."]


def test_results_that_were_changed_are_none(tmp_path):
    store = Store(tmp_path, "s")
    store.write("one", {"tpr": 0.97})
    store.write_array("panel", np.arange(6))
    path = tmp_path / "one.json"
    path.write_text(path.read_text().replace("0.97", "0.98"))
    assert store.read("one") is None
    (array,) = tmp_path.glob("s-*")
    data = bytearray(array.read_bytes())
    data[-20] ^= 1  # of a number, not of its digest
    array.write_bytes(data)
    assert store.read_array("panel") is None


def test_a_folder_that_fails_keeps_the_kind_of_the_error_and_says_its_own_name(tmp_path):
    target = tmp_path / "out"
    with pytest.raises(FileFormatError) as failed, folder_written_whole(target) as place:
        raise FileFormatError(place / "a.g2o", 3, "no space")
    assert str(failed.value) == f"{target / 'a.g2o'}:3: no space"
    assert not list(tmp_path.iterdir())
