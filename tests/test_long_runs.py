"""Short forms of the long runs in `tests/long`, and what their logs must say."""

import ast
import json
import random
import textwrap
import time
import warnings
from types import SimpleNamespace

import numpy as np
import pytest
from long import (
    _sites,
    determinism,
    differential,
    faults,
    fuzz,
    guided,
    limits,
    load,
    mutants,
    sequences,
)
from long._g2o_oracle import strict

from pcm_jax.clique import maximum_clique
from pcm_jax.errors import InputWarning
from pcm_jax.online import IncrementalPcm

SAMPLE = textwrap.dedent('''
    """Text."""

    def first(a: int = 1, *, b: "x" = True) -> float:
        """Text of 3."""
        if a < 2 and b:
            raise ValueError(f"{a + 1} given")
        note(a, b)
        for k in range(a):
            if -k in b:
                break
        return a @ b
''')


def test_changes_are_small_and_leave_words_alone():
    found = _sites.changes(SAMPLE)
    told = {(change.kind, change.before, change.after) for change in found}
    assert told == {
        ("constant", "1", "2"),
        ("constant", "1", "0"),
        ("constant", "2", "3"),
        ("constant", "2", "1"),
        ("constant", "True", "False"),
        ("comparison", "a < 2", "(a <= 2)"),
        ("comparison", "a < 2", "(a >= 2)"),
        ("comparison", "-k in b", "(-k not in b)"),
        ("logic", "a < 2 and b", "(a < 2 or b)"),
        ("logic", "a < 2 and b", "(a < 2)"),
        ("sign", "-k", "(k)"),
        ("order", "note(a, b)", "(note(b, a))"),
        ("order", "a @ b", "(b @ a)"),
        ("deleted", "note(a, b)", "pass"),
        ("deleted", 'raise ValueError(f"{a + 1} given")', "pass"),
        ("jump", "break", "continue"),
        ("return", "return a @ b", "return None"),
    }
    assert all(change.place == "first" for change in found)
    for change in found:
        ast.parse(change.applied(SAMPLE))
        assert change.applied(SAMPLE).count("\n") == SAMPLE.count("\n")


def test_mutants_were_killed_or_judged():
    """At least nine of ten that are not equivalent, in every folder; the log says why of others."""
    entries = mutants.results().values()
    alive = [entry for entry in entries if entry["result"] == "survived"]
    assert [entry["key"] for entry in alive if not entry.get("judged")] == []
    for folder in mutants.TESTS:
        own = [entry for entry in entries if entry["folder"] == folder]
        equal = [e for e in own if e.get("judged", "").startswith("equivalent: ")]
        left = [e for e in own if e["result"] == "survived" and e not in equal]
        assert len(own) >= 40
        assert len(left) <= 0.1 * (len(own) - len(equal))


def test_the_summary_is_that_of_the_results():
    told = (mutants.LOGS / "mutants.md").read_text()
    for folder in mutants.TESTS:
        count = sum(entry["folder"] == folder for entry in mutants.results().values())
        assert f"\n| {folder} | {count} |" in told


def test_mutated_files_are_read_or_refused_in_a_line():
    done = fuzz.run(range(10_000_000, 10_000_250), 15, float("inf"))
    assert done["found"] == {}
    assert done["told"]["accepted"] > 25


@pytest.mark.parametrize("number", [1004594, 1069840, 1149821, 1169514, 1209336, 1410738])
def test_inputs_of_a_long_run_that_were_not_read_or_refused(number):
    """A quaternion that signals, metres beyond floats, a log of priors alone, hard eigenvalues."""
    assert fuzz.run(range(number, number + 1), 15, float("inf"))["found"] == {}


def test_the_strict_reader_declines_what_is_not_plain():
    edge = "EDGE_SE2 0 1 1 0 0.5 1 0 0 1 0 1"
    ids, rows = strict(f"VERTEX_SE2 0 0 0 0\n{edge}\n")
    assert (ids, [list(row) for row in rows]) == ({0}, [[0, 1, 1, 0, 0.5, 1, 0, 0, 1, 0, 1]])
    for line in (edge + " 1", edge.replace("0.5", "nan"), edge.replace("0.5", "4"), "FIX 0"):
        assert strict(line) is None
    assert strict(f"VERTEX_SE2 0 0 0 0\nVERTEX_SE2 0 1 0 0\n{edge}") is None


def test_what_differs_from_the_strict_reader_is_found(tmp_path):
    edge = "EDGE_SE2 0 1 1 0 0.5 1 0 0 1 0 1\n"
    (tmp_path / "a.g2o").write_text(edge)
    graph = fuzz.read_graph(tmp_path / "a.g2o")
    assert fuzz.difference(graph, edge.encode()) == (True, None)
    for other in (edge.replace("0.5", "0.4"), edge.replace("0 1 1", "0 2 1"), edge * 2):
        plain, wrong = fuzz.difference(graph, other.encode())
        assert not plain or wrong
    assert fuzz.difference(graph, (edge + edge.replace("0.5", "0.4")).encode())[1]


def test_random_cases_agree_with_other_programs():
    pytest.importorskip("gtsam")
    for name, cases, wrong in differential.run(60, 16):
        assert cases >= 12 and wrong == [], name


@pytest.mark.slow
def test_merges_compile_nothing_more():
    """Memory is for the long run: in so few merges much is met for the first time."""
    with load.few_plans():
        done = load.run(20)
    assert [fault for fault in done["fault"] if "memory" not in fault] == []
    assert done["accepted"] > 50


@pytest.mark.slow
def test_a_killed_command_leaves_whole_files(tmp_path):
    writer = faults.Writer("stream --save", tmp_path / "writer")
    left, wrong = faults.kill(writer, 2, random.Random(0))
    assert wrong == [] and sum(left[kind] for kind in ("none", "some new", "all new")) == 2
    refused, wrong = faults.full(writer, [100])
    assert (refused, wrong) == (2, [])


def test_files_that_are_cut_short_would_be_seen(tmp_path):
    writer = object.__new__(faults.Writer)
    writer.name, writer.place, writer.whole = "calibrate --output", tmp_path, {"c.g2o": b"whole"}
    writer.out.mkdir()
    for content, old, wrong in (
        (b"whole", False, 0),
        (b"whol", False, 1),
        (faults.OLD, True, 0),
        (faults.OLD, False, 1),
        (b"", True, 1),
    ):
        (writer.out / "c.g2o").write_bytes(content)
        assert len(writer.faults(old)) == wrong
    (writer.out / "c.g2o").unlink()
    assert (writer.faults(False), writer.faults(True)) == ([], ["c.g2o is lost"])
    report = tmp_path / "r.json"
    report.write_text(json.dumps({"seconds": 1, "cost": 2}))
    assert faults.told(report) == {"cost": 2}


def test_a_folder_of_which_some_files_are_new_would_be_seen(tmp_path):
    writer = object.__new__(faults.Writer)
    writer.name, writer.place = "simulate --csv", tmp_path
    writer.whole = {faults.FOLDER: {"a": b"new a", "b": b"new b"}}
    writer.reset(True)
    assert writer.faults(True) == []
    folder = writer.out / faults.FOLDER
    assert {one.name for one in folder.iterdir()} == {"a", "b", faults.THEIRS}
    (folder / "a").write_bytes(b"new a")
    assert len(writer.faults(True)) == 1
    (folder / "b").write_bytes(b"new b")
    assert writer.faults(True) == []
    assert writer.is_new(faults.FOLDER, writer.found()[faults.FOLDER], True)
    (folder / faults.THEIRS).unlink()
    assert len(writer.faults(True)) == 1
    assert writer.faults(False) == []


@pytest.fixture
def target(tmp_path, monkeypatch):
    monkeypatch.setattr(fuzz, "binaries", lambda _: [])
    for name in ("files", "corpus"):
        (tmp_path / name).mkdir()
    return guided.Target(fuzz, tmp_path / "files", tmp_path / "corpus", 10**9, float("inf"))


def test_the_guided_fuzzer_begins_with_inputs_that_are_accepted(target, tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)
        for one in target.seeds:
            data = (tmp_path / "corpus" / one.name).read_bytes()
            assert target.parts(data) == (one, {}, one.data)
            target(data)
    assert target.told == {"tried": 15, "accepted": 15, "compared": 2}
    assert target.kinds == {}
    assert target.parts(b"")[0] in target.seeds


def test_the_guided_fuzzer_changes_the_file_of_a_seed(target):
    drawn = random.Random(0)
    atheris = SimpleNamespace(Mutate=lambda content, most: content[: most - 8] + drawn.randbytes(8))
    data = b"\x00\xff" + target.seeds[0].data
    made = [target.changed(atheris, data, 4096, number) for number in range(200)]
    assert {one[0] for one in made} == {0} and len({one[1] for one in made}) > 3
    assert len(set(made)) > 150 and max(map(len, made)) <= 4096
    for few in (b"", b"\x00", data):
        assert all(len(target.changed(atheris, few, 40, number)) <= 40 for number in range(50))


def test_the_guided_fuzzer_notes_what_it_finds(target, tmp_path, monkeypatch):
    monkeypatch.setattr(fuzz, "verdict", lambda *_: ("odd", False, False))
    for _ in range(3):
        target(b"\x01\xffdata")
    assert target.kinds == {f"{target.seeds[1].name}: odd": 3}
    (found,) = (tmp_path / "corpus" / "found").iterdir()
    assert found.read_bytes() == b"\x01\xffdata"
    assert json.loads((tmp_path / "files" / "told.json").read_text())["told"]["tried"] == 3


def test_what_libfuzzer_tells():
    text = "INFO: seed\n#19\tINITED cov: 1315 ft: 2086 corp: 18/16Kb exec/s: 0 rss: 1Mb\n"
    text += "#68627\tNEW    cov: 1707 ft: 3650 corp: 304/1Mb lim: 9 exec/s: 1 rss: 2Mb L: 9\n"
    steps = [(19, "INITED", 1315, 2086, 18), (68627, "NEW", 1707, 3650, 304)]
    assert guided.progress(text) == steps
    assert guided.is_reading("pcm_jax.files.text") and not guided.is_reading("pcm_jax.clique")


@pytest.mark.slow
def test_an_online_answer_that_is_not_the_batchs_would_be_seen(monkeypatch):
    monkeypatch.setattr(sequences, "EACH", 5)
    done = sequences.run(0, 1)
    assert done["found"] == []
    assert done["told"]["sequences"] >= 5
    monkeypatch.setattr(IncrementalPcm, "remove", lambda self, indices: None)
    assert sequences.run(0, 1, time.monotonic() + 30)["found"]


@pytest.mark.slow
def test_another_hash_seed_and_order_give_the_same_files():
    tried, wrong = determinism.run(range(1), ["hash seed 1", determinism.ORDER])
    assert tried.total() == 2 and wrong == []


def test_another_answer_would_be_seen():
    def report(cost, accepted):
        closures = [{"source": "c.csv:1", "accepted": accepted}]
        return json.dumps({"closures": closures, "solution": {"cost": cost}}).encode()

    assert determinism.same_answer(report(2.0, True), report(2.0 + 1e-10, True))
    assert not determinism.same_answer(report(2.0, True), report(2.0 + 1e-6, True))
    assert not determinism.same_answer(report(2.0, True), report(2.0, False))


@pytest.mark.parametrize("kind", list(limits.GRAPHS))
def test_graphs_for_time_limits_are_graphs(kind, monkeypatch):
    monkeypatch.setattr(limits, "BLOCK", 70)
    graph = limits.GRAPHS[kind](300)
    assert (graph == graph.T).all() and not graph.diagonal().any()
    found = maximum_clique(graph, method="heuristic")
    assert limits.fault(graph, found, 2.29, 2.0) is None
    assert limits.fault(graph, found, 2.31, 2.0) == "2.31 s where 2.0 were given"
    empty = np.zeros_like(graph)
    assert limits.fault(empty, found, 0.0, 2.0) == "no clique"
