"""Scores in comments of a g2o file, and times in the folders beside one."""

import numpy as np
import pytest

from pcm_jax.errors import FileFormatError
from pcm_jax.files import read_graph

STEP = "EDGE_SE2 {} {} 1 0 0 100 0 0 100 0 400"
FIRST = [STEP.format(0, 1), STEP.format(1, 2)]
SECOND = [STEP.format(10, 11), STEP.format(11, 12)]


@pytest.fixture
def maps(write):
    return write(*FIRST, name="a.g2o"), write(*SECOND, name="b.g2o")


def test_a_score_before_an_edge_is_its_weight(write, maps):
    pair = write(
        "# LC: 14",
        STEP.format(0, 10),
        "# another comment",
        STEP.format(1, 11),
        "#LC: 2.5",
        STEP.format(2, 12),
        name="pair.g2o",
    )
    graph = read_graph(*maps, closures=pair)
    np.testing.assert_array_equal(graph.closures.weight, [14.0, 1.0, 2.5])
    graph = read_graph(*maps, pair)
    np.testing.assert_array_equal(graph.closures.weight, [14.0, 1.0, 2.5])


@pytest.mark.parametrize("score", ["-1", "many", "nan", "inf"])
def test_a_score_that_is_no_number(write, maps, score):
    pair = write(STEP.format(1, 11), f"# LC: {score}", STEP.format(0, 10), name="pair.g2o")
    with pytest.raises(FileFormatError, match=f"pair.g2o:2: '{score}' given after '# LC:'"):
        read_graph(*maps, closures=pair)


def keyframe(folder, number, text):
    (folder / f"{number:06d}").mkdir()
    (folder / f"{number:06d}" / "data").write_text(text)


def test_times_of_keyframes(write, tmp_path):
    """Vertices keep their times whatever their order; one without a keyframe has none."""
    path = write("VERTEX_SE2 7 0 0 0", "VERTEX_SE2 4 1 0 0", "VERTEX_SE2 5 2 0 0",
                 STEP.format(7, 4), STEP.format(4, 5))  # fmt: skip
    pose = "estimate\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"
    keyframe(tmp_path, 0, f"stamp 1525765233 472314624\n{pose}accum_distance 0\nid 7\n")
    keyframe(tmp_path, 1, f"stamp 1525765235 250000000\n{pose}id 5\n")
    (one,) = read_graph(path).maps
    stamps = dict(zip(one.ids.tolist(), one.stamps.tolist(), strict=True))
    assert stamps[7] == pytest.approx(1525765233.472314624, abs=1e-6)
    assert stamps[5] == pytest.approx(1525765235.25, abs=1e-6)
    assert np.isnan(stamps[4])


def test_a_keyframe_that_cannot_be_read(write, tmp_path):
    path = write(*FIRST)
    keyframe(tmp_path, 0, "stamp soon\nid 0\n")
    with pytest.raises(FileFormatError, match="000000/data:1: 'stamp soon' given, expected 'stamp"):
        read_graph(path)


def test_other_folders_beside_a_file_say_nothing(write, tmp_path):
    path = write(*FIRST)
    keyframe(tmp_path, 0, "nothing of use\n")
    assert read_graph(path).maps[0].stamps is None
