"""Compiled programs on disk: where, how many bytes, and what the user says himself."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from pcm_jax.cli import _cache

LINE = "import os; from pcm_jax.cli import _cache; _cache.keep_compiled(); "
LINE += "print(os.environ.get('JAX_COMPILATION_CACHE_DIR', ''))"


def folder_told(tmp_path, **variables):
    """The folder that a process of its own tells JAX; the process's home is a temporary one."""
    plain = {k: v for k, v in os.environ.items() if not k.startswith(("JAX_", "PCM_", "XDG_"))}
    environment = plain | {"HOME": str(tmp_path)} | variables
    done = subprocess.run(
        [sys.executable, "-c", LINE], env=environment, capture_output=True, text=True, check=True
    )
    return done.stdout.strip()


@pytest.mark.skipif(sys.platform != "linux", reason="where caches lie is the platform's custom")
def test_in_the_users_cache_folder(tmp_path):
    told = folder_told(tmp_path)
    assert told == str(tmp_path / ".cache" / "pcm-jax" / "compiled")
    assert Path(told).is_dir()
    elsewhere = tmp_path / "elsewhere"
    assert folder_told(tmp_path, XDG_CACHE_HOME=str(elsewhere)).startswith(str(elsewhere))


def test_as_the_user_says(tmp_path):
    assert folder_told(tmp_path, PCM_JAX_CACHE="off") == ""
    assert folder_told(tmp_path, PCM_JAX_CACHE=str(tmp_path / "mine")) == str(tmp_path / "mine")
    assert folder_told(tmp_path, JAX_COMPILATION_CACHE_DIR="theirs") == "theirs"


def test_without_a_folder_it_works_all_the_same(tmp_path):
    file = tmp_path / "file"
    file.write_text("no folder")
    assert folder_told(tmp_path, PCM_JAX_CACHE=str(file / "below")) == ""


def test_the_oldest_leave(tmp_path):
    for age in range(4):
        path = tmp_path / f"{age}"
        path.write_bytes(bytes(100))
        os.utime(path, (1e9 - age, 1e9 - age))
    _cache.prune(tmp_path, 250)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["0", "1"]
