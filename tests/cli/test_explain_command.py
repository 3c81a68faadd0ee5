"""`pcm-jax explain`, from the report alone, and the schema of reports."""

import json
import subprocess
import sys
from importlib.resources import files

import jsonschema
import pytest

from pcm_jax import merge
from pcm_jax.cli import main
from pcm_jax.integrity import STANDINGS, explain
from pcm_jax.simulation import simulate_city, simulate_sessions

SCHEMA = json.loads((files("pcm_jax.merging") / "report.schema.json").read_text())
SMALL = {"poses": 60, "inliers": 6, "aliased_groups": 1, "aliased_size": 3, "random": 11}


@pytest.fixture(scope="module")
def path(city, tmp_path_factory):
    written = tmp_path_factory.mktemp("explained") / "report.json"
    assert main(["merge", str(city / "graph.g2o"), "--report", str(written)]) == 0
    return written


def test_a_closure_in_words_and_numbers(run, path):
    report = json.loads(path.read_text())
    for row in report["closures"]:
        ran = run("explain", path, row["index"])
        assert (ran.status, ran.err) == (0, "")
        first, blank, *lines = ran.out.splitlines()
        assert (first, blank) == (row["why"], "")
        told = dict(line.strip().split("  ", 1) for line in lines)
        worst = row["worst_conflict"]
        other = report["closures"][worst["with"]]
        named = {name: value.strip() for name, value in told.items()}
        assert named["worst conflict"] == f"closure {worst['with']} ({other['a']} to {other['b']})"
        assert named["translation"] == (
            f"{worst['translation']:.4g} m, sigma {worst['translation_sigma']:.4g} m"
        )
        assert named["agrees with"] == f"{row['agrees_with']} of {row['of']} accepted ones"
        assert named["standing"] == row["standing"]
        assert named["read from"] == row["source"]
        if row["enters_at"] > 1.0 - 1e-9:
            assert named["enters at"] == "no usable confidence (confidence asked for: 0.99)"
    accepted = next(row for row in report["closures"] if row["accepted"])
    assert "was accepted: it agrees with all 5 other accepted ones" in accepted["why"]


def test_json_is_the_reports_own(run, path):
    report = json.loads(path.read_text())
    assert json.loads(run("explain", path, 3, "--json").out) == report["closures"][3]


def test_jax_is_not_needed(path):
    code = "import sys; from pcm_jax.cli import main\n"
    code += f"sys.exit(main(['explain', {str(path)!r}, '0']) or 'jax' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)


def test_what_was_not_weighed(run, tmp_path):
    world = simulate_city(**SMALL)
    report = merge(world.graph, accepted=world.is_true).report()
    (tmp_path / "given.json").write_text(json.dumps(report))
    left = int(world.is_true.argmin())
    ran = run("explain", tmp_path / "given.json", left)
    assert ran.status == 0
    assert "was left out because it is not among those given" in ran.out
    assert "worst conflict" not in ran.out
    assert "chi-squared" in ran.out


def _of_fourth(report, **changes):
    report["closures"][4] |= changes
    return report


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda report: report["robots"], ": a JSON list, expected a report that pcm-jax merge"),
        (lambda report: {"robots": []}, ": JSON without 'version', expected a report"),
        (lambda report: report["closures"][2].pop("why") and report, ": closures[2] without 'why'"),
        (lambda report: report | {"closures": 7}, ": closures that are no list, expected a rep"),
        (lambda report: _of_fourth(report, fit={}), ": closures[4] with other content, expected"),
        (lambda report: _of_fourth(report, worst_conflict={"with": 10**6}), "[4] with other cont"),
        (lambda report: report | {"closures": []}, ": closure 4 asked for, but the report has no"),
        (lambda report: report | {"closures": report["closures"][:4]}, "closure 4 asked for, exp"),
    ],
)
def test_other_files_are_told_apart(run, path, tmp_path, change, message):
    other = tmp_path / "other.json"
    other.write_text(json.dumps(change(json.loads(path.read_text()))))
    ran = run("explain", other, 4)
    assert (ran.status, ran.out) == (2, "")
    (line,) = ran.err.splitlines()
    assert line.startswith(f"error: {other}")
    assert message in line


def test_what_is_no_json(run, city, tmp_path):
    ran = run("explain", city / "graph.g2o", 0)
    assert (ran.status, ran.err) == (
        2,
        f"error: {city / 'graph.g2o'}:1: no JSON: Expecting value\n",
    )
    (tmp_path / "binary").write_bytes(b"\xff\xfe\x00")
    assert "no text, expected a report" in run("explain", tmp_path / "binary", 0).err
    for text in ("[" * 100_000, "9" * 5000):  # deeper and longer than Python reads
        (tmp_path / "deep").write_text(text)
        assert "deep: no JSON: " in run("explain", tmp_path / "deep", 0).err
    assert "No such file" in run("explain", tmp_path / "nothing.json", 0).err
    assert run("explain", city / "graph.g2o", "x").status == 2


def valid(report):
    jsonschema.validate(report, SCHEMA, cls=jsonschema.Draft202012Validator)


def test_reports_follow_the_schema(path):
    jsonschema.Draft202012Validator.check_schema(SCHEMA)
    assert SCHEMA["$defs"]["closure"]["properties"]["standing"]["enum"] == list(STANDINGS)
    report = json.loads(path.read_text())
    valid(report)
    with pytest.raises(jsonschema.ValidationError, match="'why' is a required property"):
        report["closures"][0].pop("why")
        valid(report)


@pytest.mark.parametrize("options", [{}, {"method": "gnc"}, {"method": "all"}, {"accepted": [1]}])
def test_reports_of_every_kind_follow_the_schema(options):
    """A method with evidence, a robust one, everything, and closures that were given."""
    world = simulate_city(**(SMALL | {"random": 0, "aliased_groups": 0}))
    report = merge(world.graph, **options).report()
    valid(json.loads(json.dumps(report)))


def test_reports_of_a_team_in_space_follow_the_schema():
    world = simulate_sessions(seed=1, sessions=3, poses=60, inliers=8, aliased_groups=0, random=2)
    result = merge(world.graph)
    report = result.report()
    assert report["team"]
    valid(json.loads(json.dumps(report)))
    assert len(explain(result)) == len(report["closures"])
