"""DESIGN's order of the package, read from its import statements."""

import ast
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "pcm_jax"
ORDER = (
    *("errors", "arrays", "compiling", "store", "tables"),
    *("lie", "graph", "files", "sparse", "mapping", "consistency", "clique"),
    *("selection", "integrity", "merging", "pipeline", "online", "simulation", "evaluation"),
    *("plots", "report", "experiments", "cli"),
)
ONLY_IMPORT = {
    "errors": set(),
    "arrays": {"errors"},
    "compiling": set(),
    "store": set(),
    "tables": {"errors"},
    "clique": {"errors", "arrays"},
    "sparse": {"errors", "arrays"},
}
# `MergeResult.plot` and `to_html` are conveniences that reach down by one lazy import each.
DECLARED = {("merging/result.py", "plots"), ("merging/result.py", "report")}
# Folders whose modules are found by being there: a command, a format, a method is one new file.
FOUND = ("cli", "files/formats", "selection/methods")
# Modules that are not yet named by `test_private_modules_begin_with_an_underscore`: to be emptied.
MISNAMED = {
    "cli/_arguments.py",
    "files/plausibility.py",
    "files/robots.py",
    "lie/se2.py",
    "lie/se3.py",
    "mapping/_linearization.py",
    "merging/robust/weights.py",
}
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


def importers() -> dict[str, set[str]]:
    """Who imports each module of the package, as paths; by way of their folder does not count."""
    paths = {module.removesuffix(".py").replace("/", "."): module for module in MODULES}
    found = {module: set() for module in MODULES}
    for path in (path for place in (PACKAGE, ROOT / "benchmarks") for path in place.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            names = _modules_of(node)
            if isinstance(node, ast.ImportFrom):
                names = [*names, *(f"{node.module}.{alias.name}" for alias in node.names)]
            for name in names:
                module = paths.get(name.removeprefix("pcm_jax."))
                if module:
                    found[module].add(path.relative_to(ROOT).as_posix())
    return found


def is_misnamed(module: str, users: set[str]) -> bool:
    """Whether a private module has a public name, or one with an underscore is used elsewhere."""
    own = Path("pcm_jax", module).parent
    if Path(module).stem.startswith("_"):
        return any(not Path(user).is_relative_to(own) for user in users)
    exported = any(Path(user).name == "__init__.py" for user in users)
    return not exported and all(Path(user).parent == own for user in users)


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


def test_private_modules_begin_with_an_underscore():
    """Those that no `__init__` takes names from and no other folder imports, and only they."""
    ruled = {
        module: users
        for module, users in importers().items()
        if "/" in module and not module.endswith("__init__.py")
    }
    found = {module for module, users in ruled.items() if is_misnamed(module, users)}
    free = {name for name in found if name.startswith(FOUND) and "/_" not in name}
    assert found - free == MISNAMED


def test_misnamed_modules_would_be_seen():
    own, other = "pcm_jax/sparse/plan.py", "pcm_jax/mapping/solve.py"
    assert is_misnamed("sparse/fronts.py", {own})
    assert not is_misnamed("sparse/fronts.py", {own, other})
    assert not is_misnamed("sparse/fronts.py", {"pcm_jax/sparse/__init__.py"})
    assert not is_misnamed("sparse/_fronts.py", {own, "pcm_jax/sparse/deep/plan.py"})
    assert is_misnamed("sparse/_fronts.py", {own, other})


@pytest.mark.parametrize("module", MODULES)
def test_house_rules(module):
    path = PACKAGE / module
    assert path.stem not in {"utils", "util", "helpers", "misc", "common"}
    assert len(path.read_text().splitlines()) <= 400
    assert "jax.config.update" not in calls(module)
    assert not any(isinstance(node, ast.Assert) for node in ast.walk(tree_of(module)))
    if layer_of(module) not in ("cli", "__main__"):
        assert "print" not in calls(module)


RUNS_WHAT_IT_READS = {"pickle", "marshal", "shelve", "dill", "cloudpickle", "joblib", "subprocess"}


@pytest.mark.parametrize("module", MODULES)
def test_nothing_that_is_read_is_run(module):
    """No pickle, no eval, no shell: files come from other people."""
    nodes = list(ast.walk(tree_of(module)))
    assert not {name.split(".")[0] for node in nodes for name in _modules_of(node)} & (
        RUNS_WHAT_IT_READS
    )
    assert not calls(module) & {"eval", "exec", "os.system", "os.popen", "compile"}
    for node in nodes:
        if isinstance(node, ast.Call) and ast.unparse(node.func) in ("np.load", "np.save"):
            allowed = [word for word in node.keywords if word.arg == "allow_pickle"]
            assert [ast.unparse(word.value) for word in allowed] == ["False"]


def test_test_modules_have_names_of_their_own():
    """pytest imports them by their bare names, of which a process has each once."""
    names = [path.name for path in (ROOT / "tests").rglob("*.py") if path.name != "conftest.py"]
    assert sorted({name for name in names if names.count(name) > 1}) == []


def test_nothing_else_at_the_top():
    listed = subprocess.run(
        ["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    if listed.returncode:
        pytest.skip("not a git checkout")
    top = {name.split("/")[0] for name in listed.stdout.splitlines()}
    expected = {"pyproject.toml", "pcm_jax", "tests", "notebooks", "benchmarks", "README.md"}
    assert {name for name in top if not name.startswith(".")} <= expected | {"LICENSE"}
