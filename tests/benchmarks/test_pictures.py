"""The README's picture is the one that the demo draws."""

import numpy as np
import pytest
from PIL import Image

from benchmarks.pictures import __main__ as pictures


def pixels(path):
    return np.asarray(Image.open(path).convert("RGB"), dtype=int)


@pytest.mark.slow
def test_the_committed_picture_is_what_the_demo_draws(tmp_path, capsys):
    """But for letters, which other fonts set otherwise, and the maps that do not converge."""
    pictures.main(tmp_path / "demo.png")
    assert "15    15      0" in capsys.readouterr().out
    drawn, committed = pixels(tmp_path / "demo.png"), pixels(pictures.PICTURE)
    assert drawn.shape == committed.shape
    width = drawn.shape[1] // 3
    for panel in (0, 2):  # the truth, and the map merged by PCM
        part = np.s_[:, panel * width : (panel + 1) * width]
        other = np.abs(drawn[part] - committed[part]).max(axis=-1) > 64
        assert other.mean() < 0.02
