"""Short forms of the long runs in `tests/long`, and what their logs must say."""

import ast
import json
import random
import textwrap

import pytest
from long import _sites, differential, faults, fuzz, load, mutants
from long._g2o_oracle import strict

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
        assert len(own) >= 12
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
