"""Lint, format and types, as tests, so that one command checks everything."""

import ast
import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.mark.parametrize(
    "command",
    [
        ["ruff", "check", "--no-cache", "."],
        ["ruff", "format", "--no-cache", "--check", "."],
        ["pyright", "--pythonpath", sys.executable],
    ],
    ids=["lint", "format", "types"],
)
def test_clean(command):
    tool = command[0]
    if importlib.util.find_spec(tool) is None:
        pytest.skip(f"{tool} is not installed; pip install '.[dev]' does it")
    done = subprocess.run(
        [sys.executable, "-m", *command], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr


# Folders where all first lines are as they should be; the others follow.
FOLDERS = ("cli", "evaluation", "experiments", "plots", "simulation", "store.py", "tables.py")
QUESTION = re.compile(r"(What|Which|Whether|Of|How|Where|When|Why)\b")


@pytest.mark.parametrize("place", [*(f"pcm_jax/{name}" for name in FOLDERS), "benchmarks"])
def test_docstrings_begin_with_a_verb_or_a_noun(place):
    found = []
    for path in [ROOT / place] if place.endswith(".py") else (ROOT / place).rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
                first = (ast.get_docstring(node) or "").partition("\n")[0]
                found += [f"{path.name}: {first}"] if QUESTION.match(first) else []
    assert found == []


@pytest.mark.parametrize(
    "folder",
    [*(f"pcm_jax/{name}" for name in FOLDERS if "." not in name), "benchmarks/experiments"],
)
def test_a_folder_opens_with_a_map_of_its_modules(folder):
    names = {path.stem for path in (ROOT / folder).glob("*.py")} - {"__init__"}
    told = ast.get_docstring(ast.parse((ROOT / folder / "__init__.py").read_text()))
    mapped = re.findall(r"^ *(\w+(?:, \w+)*)  ", told, re.MULTILINE)
    assert {name for line in mapped for name in line.split(", ")} == names


def test_messages_propose_what_can_be_installed():
    """Nothing is published, so an extra comes from the clone: `pip install '.[plot]'`."""
    sources = [*(ROOT / "pcm_jax").rglob("*.py"), *(ROOT / "benchmarks").rglob("*.py")]
    sources += [ROOT / "README.md", *(ROOT / "notebooks").glob("*.ipynb")]
    assert [path.name for path in sources if "install 'pcm-jax" in path.read_text()] == []
