"""Whatever the bytes, a reader gives a graph or an `InputError` of one line."""

import warnings

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pcm_jax.errors import InputError, InputWarning
from pcm_jax.files import read_graph, read_tum

KEY = ord("a") << 56
LINES = [
    "VERTEX_SE2 0 0 0 0",
    "VERTEX_SE2 1 1 0 0.5",
    "EDGE_SE2 0 1 1 0 0.5 1 0 0 1 0 1",
    f"VERTEX_SE3:QUAT {KEY} 0 0 0 0 0 0 1",
    f"VERTEX_SE3:QUAT {KEY + 1} 0 0 0 0 0 0 1",
    f"EDGE_SE3:QUAT {KEY} {KEY + 1} 1 2 3 0 0 0 1 1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1",
    "EDGE2 1 2 1 0 0.5 1 0 1 1 0 0",
    "EDGE3 0 1 1 2 3 0.1 0.2 0.3 1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1",
    "# pcm_jax robot a index rover",
    "# pcm_jax id-table graph.ids.csv",
    "FIX 0",
    "EDGE_PRIOR_SE2 0 1 2 3",
    "a,0,b,1,1,2,3,4,5,6",
    "0 1 2 3 0 0 0 1",
]
WORDS = [
    *{word for line in LINES for word in line.split()},
    *("nan", "-inf", "1e400", "1e99", "-1e-99", "9" * 30, "9223372036854775807", "-0", "1_0", "x"),
]
words = st.sampled_from(WORDS)
mutated = st.lists(
    st.one_of(
        st.sampled_from(LINES),
        st.builds(
            lambda line, word, at: " ".join(
                word if k == at else other for k, other in enumerate(line.split())
            ),
            st.sampled_from(LINES),
            words,
            st.integers(0, 12),
        ),
        st.lists(words, max_size=14).map(" ".join),
        st.text(max_size=20),
    ),
    max_size=8,
).map("\n".join)
quietly = settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


def read(path, reader, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)
        try:
            reader(path, **options)
        except InputError as error:
            assert "\n" not in str(error)
            assert str(path) in str(error)


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return tmp_path_factory.mktemp("fuzz") / "graph.g2o"


@quietly
@given(data=st.one_of(st.binary(max_size=60), st.binary(max_size=20).map(b"\x1f\x8b".__add__)))
def test_bytes(path, data):
    path.write_bytes(data)
    read(path, read_graph)
    read(path, read_tum)


@quietly
@given(
    text=mutated,
    information=st.sampled_from(["as-written", "sqrt"]),
    rotation=st.sampled_from(["tangent", "quaternion"]),
    repair=st.sampled_from([None, "clip"]),
)
def test_mutated_lines(path, text, information, rotation, repair):
    path.write_bytes(text.encode("utf-8", "surrogatepass"))
    read(path, read_graph, information=information, rotation_information=rotation, repair=repair)


@quietly
@given(
    rows=st.lists(
        st.lists(st.one_of(words, st.sampled_from(["a", "b", '"', ""])), max_size=14).map(",".join),
        max_size=4,
    ),
    start=st.sampled_from(["", "a,0,a,1,1,2,3,4,5,6\n", "robot_a,id_a,robot_b,id_b,x,y,theta\n"]),
)
def test_candidates(path, rows, start):
    path.write_text("\n".join(LINES[:3]))
    table = path.with_suffix(".csv")
    table.write_text(start + "\n".join(rows))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)
        try:
            read_graph(path, closures=table)
        except InputError as error:
            assert str(table) in str(error)
