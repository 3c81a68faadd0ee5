"""DESIGN's order of the package, read from its import statements."""

import ast
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "pcm_jax"
ORDER = (
    *("errors", "arrays", "store", "tables"),
    *("lie", "graph", "files", "sparse", "mapping", "consistency", "clique"),
    *("selection", "integrity", "merging", "online", "pipeline", "simulation", "evaluation"),
    *("plots", "report", "experiments", "cli"),
)
ONLY_IMPORT = {
    "errors": set(),
    "arrays": {"errors"},
    "store": set(),
    "tables": {"errors"},
    "clique": {"errors", "arrays"},
    "sparse": {"errors", "arrays"},
}
# `MergeResult.plot` is a convenience that reaches down by one lazy import.
DECLARED = {("merging/result.py", "plots")}
MODULES = sorted(path.relative_to(PACKAGE).as_posix() for path in PACKAGE.rglob("*.py"))
LAYERED = [name for name in MODULES if name not in ("__init__.py", "__main__.py")]


def tree_of(module: str) -> ast.Module:
    return ast.parse((PACKAGE / module).read_text())


def layer_of(module: str) -> str:
    return module.split("/", maxsplit=1)[0].removesuffix(".py")


def imported_layers(module: str) -> set[str]:
    """The layers that a module imports from, anywhere in its text."""
    names = set()
    for node in ast.walk(tree_of(module)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}: imports are absolute"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    parts = [name.split(".") for name in names if name.split(".")[0] == "pcm_jax"]
    return {part[1] for part in parts if len(part) > 1 and part[1] != "__version__"}


def calls(module: str) -> set[str]:
    """The names called in a module, as written."""
    nodes = ast.walk(tree_of(module))
    return {ast.unparse(node.func) for node in nodes if isinstance(node, ast.Call)}


def test_every_folder_has_its_place():
    assert {layer_of(name) for name in LAYERED} <= set(ORDER)


@pytest.mark.parametrize("module", LAYERED)
def test_imports_come_from_rows_above(module):
    layer = layer_of(module)
    above = ONLY_IMPORT.get(layer, set(ORDER[: ORDER.index(layer)]))
    declared = {target for name, target in DECLARED if name == module}
    assert imported_layers(module) - {layer} - declared <= above


def test_declared_imports_are_lazy():
    for module, target in DECLARED:
        top = [node for node in tree_of(module).body if isinstance(node, ast.ImportFrom)]
        assert not any(f"pcm_jax.{target}" in (node.module or "") for node in top)
        assert target in imported_layers(module), "no longer needed"


def test_matplotlib_is_imported_for_pictures_only():
    importing = {
        layer_of(module)
        for module in MODULES
        for node in ast.walk(tree_of(module))
        for name in _modules_of(node)
        if name.split(".")[0] == "matplotlib"
    }
    assert importing == {"plots", "cli"}


def _modules_of(node: ast.AST) -> list[str]:
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    return [node.module or ""] if isinstance(node, ast.ImportFrom) else []


@pytest.mark.parametrize("module", MODULES)
def test_house_rules(module):
    path = PACKAGE / module
    assert path.stem not in {"utils", "util", "helpers", "misc", "common"}
    assert len(path.read_text().splitlines()) <= 400
    assert "jax.config.update" not in calls(module)
    assert not any(isinstance(node, ast.Assert) for node in ast.walk(tree_of(module)))
    if layer_of(module) not in ("cli", "__main__"):
        assert "print" not in calls(module)


def test_nothing_else_at_the_top():
    listed = subprocess.run(
        ["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    if listed.returncode:
        pytest.skip("not a git checkout")
    top = {name.split("/")[0] for name in listed.stdout.splitlines()}
    expected = {"pyproject.toml", "pcm_jax", "tests", "notebooks", "benchmarks", "README.md"}
    assert {name for name in top if not name.startswith(".")} <= expected | {"LICENSE"}
