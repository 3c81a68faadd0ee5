"""Pictures that the command line writes."""

from __future__ import annotations

import gzip
from pathlib import Path

import pytest

from pcm_jax.cli._outputs import save_picture


@pytest.mark.parametrize("kind", ["svg", "svgz", "pdf", "eps", "png"])
def test_the_same_figure_gives_the_same_bytes_on_another_day(kind, tmp_path, monkeypatch):
    pyplot = pytest.importorskip("matplotlib.pyplot")
    pictures = []
    for day in ("86400", "172800"):  # matplotlib dates pictures by this, where it is set
        monkeypatch.setenv("SOURCE_DATE_EPOCH", day)
        monkeypatch.setattr(gzip.time, "time", lambda: float(day))  # noqa: B023
        figure, ax = pyplot.subplots()
        ax.plot([0, 1], [1, 0], marker="o", clip_on=True, label="one")
        save_picture(Path(tmp_path / f"{day}.{kind}"), ax)
        pyplot.close(figure)
        pictures.append((tmp_path / f"{day}.{kind}").read_bytes())
    assert len(pictures[0]) > 1000
    assert pictures[0] == pictures[1]
