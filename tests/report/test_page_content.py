"""The page as text: what it says, that nothing in it can be taken for markup, that it is alone."""

import base64
import dataclasses
import hashlib
import json
import re
from html.parser import HTMLParser
from importlib.resources import files

import numpy as np
import pytest

import pcm_jax
from pcm_jax import lie
from pcm_jax.consistency import Evidence, PairEvidence
from pcm_jax.graph import LoopClosures, MultiRobotGraph, PoseGraph
from pcm_jax.merging import MergeResult
from pcm_jax.report import page, vendored
from pcm_jax.selection import Selection
from pcm_jax.selection.result import PairSelection

LIMIT = 5_000_000
LICENCES = re.compile(r"/\*!.*?\*/|^// https://d3js\.org.*$", re.DOTALL | re.MULTILINE)
VOID = {"meta", "link", "input", "br"}


class Page(HTMLParser):
    """Reads a page into rows: tags with attributes and what text they hold."""

    def __init__(self, text):
        super().__init__(convert_charrefs=True)
        self.open, self.elements = [], []
        self.feed(text)
        self.close()
        assert self.open == [], "every element is closed"

    def handle_starttag(self, tag, attrs):
        element = {"tag": tag, "attributes": dict(attrs), "text": "", "inside": list(self.open)}
        self.elements.append(element)
        if tag not in VOID:
            self.open.append(element)

    def handle_endtag(self, tag):
        assert self.open.pop()["tag"] == tag

    def handle_data(self, data):
        for element in self.open:
            element["text"] += data

    def all(self, tag, **attributes):
        return [
            element
            for element in self.elements
            if element["tag"] == tag
            and all(element["attributes"].get(k) == v for k, v in attributes.items())
        ]

    def data(self):
        (script,) = self.all("script", type="application/json")
        return json.loads(script["text"])


def rows_of(read):
    return [row for row in read.all("tr") if "data-closure" in row["attributes"]]


def cells_of(read, row):
    return [c["text"] for c in read.elements if c["tag"] in ("th", "td") and row in c["inside"]]


def test_every_closure_has_a_row(result, document):
    read = Page(document)
    rows = rows_of(read)
    assert [int(row["attributes"]["data-closure"]) for row in rows] == list(range(20))
    accepted = [row["attributes"]["data-fate"] == "accepted" for row in rows]
    assert accepted == result.accepted.tolist()
    for row, told in zip(rows, result.report()["closures"], strict=True):
        cells = cells_of(read, row)
        assert cells[0] == str(told["index"])
        assert cells[1] == f"{told['a']} → {told['b']}"
        assert cells[3] == told["why"]
        assert cells[4] == f"{told['agrees_with']} of {told['of']}"
        times = np.sqrt(told["worst_conflict"]["squared"] / result.gate)
        shown, other = cells[5].split("\u00a0× with\u00a0")
        assert float(shown) == pytest.approx(times, rel=0.05)
        assert int(other) == told["worst_conflict"]["with"]


def test_members_of_the_rival_are_told_apart(result, document):
    (pair,) = result.selection.pairs
    fates = {
        row["attributes"]["data-closure"]: row["attributes"]["data-fate"]
        for row in rows_of(Page(document))
    }
    rival = pair.closures[pair.verdict.rival.members]
    assert len(rival) == 3
    assert sorted(int(k) for k, fate in fates.items() if fate == "rival") == sorted(rival.tolist())


def test_the_first_screen_answers(document):
    read = Page(document)
    (title,) = read.all("h1")
    assert title["text"] == "The maps of a and b were merged into one"
    answer = read.all("section", id="answer")[0]["text"]
    assert "6 of 20 measured closures were accepted; the other 14 were rejected." in answer
    assert "Rival" in answer
    assert "Proven" in answer
    assert "p = " in answer


def test_refused_maps_are_said_to_be_apart(refused):
    read = Page(page(refused, refused.report()))
    assert not refused.accepted.any()
    assert read.all("h1")[0]["text"] == "The maps of a and b were not merged"
    answer = read.all("section", id="answer")[0]["text"]
    assert refused.report()["robot_pairs"][0]["why"] in answer
    assert "another set of closures explains the maps about as well" in answer
    by = [figure["attributes"]["data-by"] for figure in read.all("div", **{"data-draw": "rival"})]
    assert by == ["found", "rival"]
    assert read.all("div", **{"data-draw": "after"}) == []


def test_members_of_a_refused_set_are_told_apart(refused):
    (pair,) = refused.selection.pairs
    fates = [
        row["attributes"]["data-fate"] for row in rows_of(Page(page(refused, refused.report())))
    ]
    expected = pair.closures[pair.members].tolist()
    assert len(expected) == 4
    assert [k for k, fate in enumerate(fates) if fate == "refused"] == expected
    assert fates.count("rival") == 4


def test_warnings_and_hints_are_shown(result):
    report = result.report() | {"warnings": ["mind <this>"], "hints": ["try that"]}
    read = Page(page(result, report))
    told = [row["text"] for row in read.all("li") if "Look at this" in row["text"]]
    assert told == ["Look at this: mind <this>", "Look at this: try that"]


def test_lines_of_files_that_were_not_read_are_told(result):
    files = [{"path": "a.g2o", "left_out": {"FIX": 2}}, {"path": "b.g2o", "left_out": {}}]
    text = page(result, result.report() | {"input": {"files": files, "notes": ["1 row skipped"]}})
    assert "a.g2o (skipped 2 lines (2 FIX)), b.g2o<" in text
    assert "1 row skipped" in text


def test_without_evidence_there_is_no_matrix(given):
    read = Page(page(given, given.report()))
    assert read.data()["pairs"] == []
    assert read.all("section", id="agreement") == []
    assert len(rows_of(read)) == 20


def test_sections_are_named_and_listed(document):
    read = Page(document)
    by_id = {e["attributes"].get("id"): e for e in read.elements}
    sections = [section["attributes"] for section in read.all("section")]
    links = [link["attributes"]["href"] for link in read.all("a") if link["inside"]]
    for section in sections:
        assert f"#{section['id']}" in links
        name = by_id[section["aria-labelledby"]]
        assert name["tag"] in ("h1", "h2")
    ids = [e["attributes"]["id"] for e in read.elements if "id" in e["attributes"]]
    assert len(ids) == len(set(ids))


def test_names_cannot_be_taken_for_markup(hostile):
    text = page(hostile, hostile.report())
    read = Page(text)
    names = hostile.graph.names
    assert "<script>alert" not in text
    assert "<img" not in text
    assert read.all("img") == []
    assert names[0] in read.all("h1")[0]["text"]
    assert [robot["name"] for robot in read.data()["robots"]] == list(names)
    sources = {
        cell["attributes"].get("data-source") for cell in read.all("td", **{"class": "ends"})
    }
    assert sources == {"</script>:3"}


def test_data_cannot_end_their_element(hostile):
    text = page(hostile, hostile.report())
    data = text.split('type="application/json" id="data">')[1].split("</script>")[0]
    assert not set("<>&") & set(data)
    assert json.loads(data)["robots"][0]["name"] == hostile.graph.names[0]


def test_the_page_asks_for_nothing(document):
    read = Page(document)
    assert not re.search(r"https?:(?!//www\.w3\.org/)", LICENCES.sub("", document))
    for element in read.elements:
        named = {"src", "srcset", "action", "data", "poster"} & set(element["attributes"])
        assert not named or element["tag"] == "section"
        assert element["attributes"].get("href", "#").startswith(("#", "data:,"))
        assert not any(name.startswith("on") for name in element["attributes"])
        assert "style" not in element["attributes"], "the policy would refuse it"
    style = read.all("style")[0]["text"]
    assert "url(" not in style
    assert "@import" not in style


def test_the_policy_names_what_runs_by_its_hash(document):
    read = Page(document)
    (meta,) = read.all("meta", **{"http-equiv": "Content-Security-Policy"})
    policy = dict(part.strip().split(" ", 1) for part in meta["attributes"]["content"].split(";"))
    scripts = [script for script in read.all("script") if "type" not in script["attributes"]]
    assert policy["default-src"] == "'none'"
    for given, texts in (("script-src", scripts), ("style-src", read.all("style"))):
        hashes = [base64.b64encode(hashlib.sha256(e["text"].encode()).digest()) for e in texts]
        assert policy[given] == " ".join(f"'sha256-{one.decode()}'" for one in hashes)


def test_the_same_result_gives_the_same_bytes(result, document, tmp_path):
    result.to_html(tmp_path / "one.html")
    assert (tmp_path / "one.html").read_text(encoding="utf-8") == document
    assert document.endswith("</html>\n")


def test_libraries_are_whole_and_listed():
    folder = files("pcm_jax.report") / "vendor"
    listed = vendored()
    for entry in listed:
        content = (folder / entry["file"]).read_bytes()
        assert hashlib.sha256(content).hexdigest() == entry["sha256"]
        assert entry["licence"] in ("MIT", "ISC", "BSD-3-Clause", "Apache-2.0")
        assert len((folder / entry["licence_file"]).read_text()) > 500
        assert re.fullmatch(rf"npm:\w+@{re.escape(entry['version'])}, .*", entry["source"])
    expected = {entry[key] for entry in listed for key in ("file", "licence_file")}
    assert {path.name for path in folder.iterdir()} == expected | {"vendored.json"}


def test_licences_are_in_the_page(document):
    assert "Copyright 2010-2023 Mike Bostock" in document
    assert "Copyright (c) Tristen Brown" in document


@pytest.fixture(scope="module")
def large():
    """Two robots of 5,000 poses each with 1,000 closures, of random distances."""
    generator = np.random.default_rng(0)
    maps = [_wandering(generator, name) for name in ("first_robot", "second_robot")]
    ends = generator.integers(0, 5000, (2, 1000))
    closures = LoopClosures.from_arrays(
        robot_a=np.zeros(1000, int),
        pose_a=ends[0],
        robot_b=np.ones(1000, int),
        pose_b=ends[1],
        measurement=lie.exp(lie.group_of(maps[0].poses), generator.normal(size=(1000, 3))),
        information=np.tile(np.eye(3), (1000, 1, 1)),
        source=[f"some_folder/some_file.g2o:{line}" for line in range(1000)],
    )
    graph = MultiRobotGraph(tuple(maps), closures)
    accepted = np.arange(1000) < 400
    squared = generator.lognormal(3.0, 2.0, (1000, 1000))
    pair = dataclasses.replace(
        PairEvidence.from_squared(squared), closures=np.arange(1000), measured=closures
    )
    chosen = PairSelection(pair, 11.3, accepted, True, 400, 400, members=accepted)
    apart = pcm_jax.merge(graph, accepted=np.zeros(1000, bool), optimized=True)
    result = dataclasses.replace(
        apart,
        graph=MultiRobotGraph(tuple(maps), closures[accepted]),
        accepted=accepted,
        groups=((0, 1),),
    )
    evidence = Evidence(graph, tuple(maps), (), (pair,), "mahalanobis", {})
    chosen = Selection(accepted, (chosen,), "pcm-exact", 0.99, 11.3, evidence, {})
    return dataclasses.replace(result, selection=chosen, gate=11.3, confidence=0.99)


def _wandering(generator, name):
    steps = np.stack([np.full(4999, 1.0), np.zeros(4999), generator.normal(0, 0.2, 4999)], axis=1)
    heading = np.concatenate([[0.0], np.cumsum(steps[:, 2])])
    x = np.concatenate([[0.0], np.cumsum(np.cos(heading[:-1]))])
    y = np.concatenate([[0.0], np.cumsum(np.sin(heading[:-1]))])
    matrices = np.zeros((5000, 3, 3))
    matrices[:, :2, :2] = np.stack(
        [np.cos(heading), -np.sin(heading), np.sin(heading), np.cos(heading)], axis=1
    ).reshape(-1, 2, 2)
    matrices[:, :, 2] = np.stack([x, y, np.ones(5000)], axis=1)
    made = PoseGraph.from_trajectory(matrices, sigma_translation=0.1, sigma_rotation=0.01)
    return dataclasses.replace(made, name=name)


def test_a_large_merge_stays_under_five_megabytes(large):
    assert isinstance(large, MergeResult)
    report = {**dataclasses.replace(large, selection=None).report(), "gate": 11.3}
    for row in report["closures"]:
        row["why"] = f"Closure {row['index']} " + "says so in many words. " * 15
    text = page(large, report)
    data = json.loads(text.split('id="data">')[1].split("</script>")[0])
    assert text.count('<tr id="closure-') == 1000
    assert len(data["pairs"][0]["distances"]) > 600_000, "all distances are there"
    assert sum(len(robot["merged"][0]) for robot in data["robots"]) == 10_000
    assert len(text.encode()) < LIMIT
