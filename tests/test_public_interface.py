"""`import pcm_jax`: the names it offers, and what it costs."""

import ast
import importlib
import inspect
import json
import subprocess
import sys
from pathlib import Path

import pytest

import pcm_jax

HEAVY = ("equinox", "jax", "lineax", "matplotlib", "networkx", "optimistix", "scipy")


def python(code: str) -> str:
    """What a fresh process prints."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return done.stdout.strip()


def test_importing_loads_nothing_heavy():
    """Stricter than any measured time, which would depend on the machine."""
    loaded = python(f"import sys, pcm_jax; print(*[m for m in {HEAVY} if m in sys.modules])")
    assert loaded == ""


def test_reading_and_merging_names_load_no_optional_packages():
    code = (
        "import sys, pcm_jax; pcm_jax.merge, pcm_jax.read_graph; print('matplotlib' in sys.modules)"
    )
    assert python(code) == "False"


@pytest.mark.parametrize("name", pcm_jax.__all__)
def test_every_name_is_there_documented_and_annotated(name):
    value = getattr(pcm_jax, name)
    assert value.__name__ == name
    assert inspect.getdoc(value)
    if inspect.isfunction(value):
        signature = inspect.signature(value)
        kinds = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
        named = [p for p in signature.parameters.values() if p.kind not in kinds]
        assert all(p.annotation is not p.empty for p in named), name
        assert signature.return_annotation is not signature.empty, name


def test_names_for_type_checkers_are_the_names_that_load():
    """The imports under TYPE_CHECKING, `__all__` and the table behind `__getattr__` agree."""
    tree = ast.parse(Path(pcm_jax.__file__).read_text())
    checked = {
        alias.name: str(node.module)
        for branch in tree.body
        if isinstance(branch, ast.If)
        for node in branch.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    modules = {name for name, home in checked.items() if home == "pcm_jax"}
    assert modules == set(pcm_jax._MODULES)
    names = {name: home for name, home in checked.items() if name not in modules}
    assert sorted(names) == pcm_jax.__all__
    for name, module in names.items():
        assert getattr(importlib.import_module(module), name) is getattr(pcm_jax, name)


@pytest.fixture(scope="module")
def reached():
    """Each module's name, and whether pictures' package is there; none of ours before it is."""
    code = f"""
import json, sys
found = {{}}
for name in {pcm_jax._MODULES}:
    for loaded in [each for each in sys.modules if each.partition(".")[0] == "pcm_jax"]:
        del sys.modules[loaded]
    import pcm_jax
    found[name] = getattr(pcm_jax, name).__name__, "matplotlib" in sys.modules
print(json.dumps(found))
"""
    return json.loads(python(code))


@pytest.mark.slow
@pytest.mark.parametrize("name", pcm_jax._MODULES)
def test_modules_need_no_second_import(reached, name):
    """Where nothing else has imported them; the pictures load no matplotlib."""
    assert reached[name] == [f"pcm_jax.{name}", False]


def test_dir_and_unknown_names():
    assert {*pcm_jax.__all__, *pcm_jax._MODULES} <= set(dir(pcm_jax))
    with pytest.raises(AttributeError, match="no attribute 'no_such_name'"):
        _ = pcm_jax.no_such_name


@pytest.mark.slow
def test_importing_every_module_leaves_the_settings_alone():
    code = """
import importlib, pkgutil, jax, pcm_jax
before = dict(jax.config.values)
for module in pkgutil.walk_packages(pcm_jax.__path__, "pcm_jax."):
    if not module.name.endswith("__main__"):
        importlib.import_module(module.name)
print(sorted(name for name, value in jax.config.values.items() if before[name] != value))
"""
    assert python(code) == "[]"
