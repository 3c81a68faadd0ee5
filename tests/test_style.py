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
        pytest.param(["pyright", "--pythonpath", sys.executable], marks=pytest.mark.slow),
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


PACKAGE = ROOT / "pcm_jax"
SOURCES = sorted([*PACKAGE.rglob("*.py"), *(ROOT / "benchmarks").rglob("*.py")])
MAPPED = sorted(path.parent for path in PACKAGE.rglob("__init__.py") if path.parent != PACKAGE)
MAPPED = [*MAPPED, ROOT / "benchmarks" / "experiments"]
LATER: tuple[str, ...] = ()
QUESTION = re.compile(r"(What|Which|Whether|Of|How|Where|When|Why)\b")


def named(path):
    return path.relative_to(ROOT).as_posix()


def guarded(paths):
    return [named(path) for path in paths if not f"{named(path)}/".startswith(LATER)]


@pytest.mark.parametrize("module", guarded(SOURCES))
def test_docstrings_begin_with_a_verb_or_a_noun(module):
    documented = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef
    nodes = ast.walk(ast.parse((ROOT / module).read_text()))
    told = [ast.get_docstring(node) or "" for node in nodes if isinstance(node, documented)]
    firsts = [text.partition("\n")[0] for text in told]
    assert [first for first in firsts if QUESTION.match(first)] == []


@pytest.mark.parametrize("folder", guarded(MAPPED))
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
