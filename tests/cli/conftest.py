"""A small simulated city, written once, and a way to run commands on it."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from pcm_jax.cli import main

SMALL = ["--poses=60", "--inliers=6", "--aliased-groups=1", "--aliased-size=3", "--random=11"]


class Ran(NamedTuple):
    """What a command left behind."""

    status: int
    out: str
    err: str


@pytest.fixture
def run(capsys) -> Callable[..., Ran]:
    """Runs `pcm-jax` with the arguments given, in this process."""

    def command(*arguments: Any) -> Ran:
        try:
            status = main([str(argument) for argument in arguments])
        except SystemExit as end:  # argparse's way out
            status = int(end.code or 0)
        return Ran(status, *capsys.readouterr())

    return command


@pytest.fixture(scope="session")
def city(tmp_path_factory) -> Path:
    """A folder that `pcm-jax simulate city` wrote, maps and closures in one file."""
    folder = tmp_path_factory.mktemp("worlds") / "city"
    assert main(["simulate", "city", "--output", str(folder), *SMALL]) == 0
    return folder


@pytest.fixture(scope="session")
def plain_city(tmp_path_factory) -> Path:
    """The same world as plain files and candidates."""
    folder = tmp_path_factory.mktemp("worlds") / "plain"
    assert main(["simulate", "city", "--csv", "--output", str(folder), *SMALL]) == 0
    return folder


@pytest.fixture(scope="session")
def labels(city) -> dict[str, Any]:
    return json.loads((city / "labels.json").read_text())
