"""The benchmarks are no part of the installed package: they are found in the checkout."""

import sys
from pathlib import Path

import pytest
from square_walk import write_files

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))


@pytest.fixture(scope="session")
def square_walk_files(tmp_path_factory):
    """A folder with one file of either collection of real candidates, made up."""
    folder = tmp_path_factory.mktemp("data")
    write_files(folder)
    return folder
