"""Notebooks as they are committed; nbmake runs them (`--nbmake` in pyproject.toml)."""

import ast
import json
import re
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
LIBRARIES = {"IPython", "equinox", "jax", "jaxlie", "matplotlib", "networkx", "numpy", "optax"}
LIBRARIES |= {"pcm_jax", "scipy"}
MACHINE_PATH = re.compile(r"(?<![\w.])/(?:home|root|tmp|usr|var|work|Users|opt|mnt)/|[A-Z]:\\")
MOST_BYTES = 1_000_000
MOST_LINES = 25


@pytest.fixture(params=NOTEBOOKS, ids=lambda path: path.stem)
def path(request):
    return request.param


@pytest.fixture
def notebook(path):
    return json.loads(path.read_text())


def code_of(notebook):
    return [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]


def outputs_of(notebook):
    return [output for cell in code_of(notebook) for output in cell["outputs"]]


def texts_of(output):
    """Everything of an output that is text, not a picture."""
    data = {key: text for key, text in output.get("data", {}).items() if key.startswith("text/")}
    return ["".join(text) for text in (output.get("text", ""), *data.values())]


def tree_of(notebook):
    """Its code as one program; a line that starts with % is IPython's."""
    lines = [line for cell in code_of(notebook) for line in [*cell["source"], "\n"]]
    return ast.parse("".join(line for line in lines if not line.startswith("%")))


def test_pytest_runs_them():
    options = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["pytest"]["ini_options"]
    assert "--nbmake" in options["addopts"].split()
    assert "notebooks" in options["testpaths"]
    assert NOTEBOOKS


def test_run_from_top_to_bottom(notebook):
    counts = [cell["execution_count"] for cell in code_of(notebook)]
    assert counts == list(range(1, len(counts) + 1))


def test_outputs_are_kept_and_clean(notebook):
    outputs = outputs_of(notebook)
    assert any("image/png" in output.get("data", {}) for output in outputs)
    assert all(output["output_type"] != "error" for output in outputs)
    assert all(output.get("name") != "stderr" for output in outputs)


def test_no_paths_of_a_machine(notebook):
    sources = ["".join(cell["source"]) for cell in notebook["cells"]]
    texts = [text for output in outputs_of(notebook) for text in texts_of(output)]
    assert [text for text in [*sources, *texts] if MACHINE_PATH.search(text)] == []


def test_small_enough_to_open_on_a_phone(path, notebook):
    assert path.stat().st_size < MOST_BYTES
    assert all(len(cell["source"]) <= MOST_LINES for cell in code_of(notebook))


def test_begins_with_a_title_and_enables_x64(path, notebook):
    assert re.fullmatch(r"\d\d_\w+", path.stem)
    first = notebook["cells"][0]
    assert first["cell_type"] == "markdown"
    assert first["source"][0].startswith("# ")
    assert 'jax.config.update("jax_enable_x64", True)' in ast.unparse(tree_of(notebook)).replace(
        "'", '"'
    )
    assert notebook["metadata"]["kernelspec"]["name"] == "python3"


def test_only_public_names(notebook):
    """What anybody has who installed the package: neither private names nor the repository."""
    imported, attributes = set(), set()
    for node in ast.walk(tree_of(notebook)):
        if isinstance(node, ast.Import):
            imported |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            imported |= {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Attribute):
            attributes.add(node.attr)
    parts = [name.split(".") for name in imported]
    assert {part[0] for part in parts} <= LIBRARIES | sys.stdlib_module_names
    private = [name for part in parts for name in part if name.startswith("_")]
    assert private + [name for name in attributes if name.startswith("_")] == []
