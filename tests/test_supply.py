"""The record of installed packages: by name, version and hash."""

import json

import pytest
import supply

ONE = {
    "metadata": {"name": "Some_Package", "version": "1.2"},
    "download_info": {"archive_info": {"hashes": {"sha256": "a" * 64}}},
}
OWN = {"metadata": {"name": "pcm-jax", "version": "0"}, "download_info": {"dir_info": {}}}
REPORT = json.dumps({"install": [ONE, OWN]})


def test_a_report_becomes_lines_and_lines_become_packages():
    found = supply.installed(REPORT)
    assert found == {"some-package": ("1.2", "a" * 64)}
    lines = supply.as_lines(found)
    assert lines == [f"some-package==1.2 --hash=sha256:{'a' * 64}"]
    assert supply.recorded(lines) == found


@pytest.mark.parametrize(
    ("known", "said"),
    [
        ({"some-package": ("1.2", "a" * 64)}, []),
        ({"some-package": ("1.2", "b" * 64)}, ["some-package 1.2: another file"]),
        ({"some-package": ("1.1", "b" * 64)}, ["some-package 1.2 (1.1 recorded)"]),
        ({}, ["some-package 1.2 (not recorded)"]),
    ],
)
def test_what_differs_is_said(known, said):
    assert supply.differences(supply.installed(REPORT), known) == said


def test_the_head_of_a_run(tmp_path, monkeypatch):
    monkeypatch.delenv("PIP_REPORT", raising=False)
    assert supply.header() == []
    path = tmp_path / "installed.json"
    path.write_text(REPORT)
    monkeypatch.setenv("PIP_REPORT", str(path))
    first, second = supply.header()
    assert first == "installed: 0 packages as recorded in tests/installed.txt"
    assert second == "some-package 1.2 (not recorded)"


def test_what_the_package_needs_is_recorded():
    known = supply.recorded(supply.RECORD.read_text().splitlines())
    assert len(known) == len(supply.RECORD.read_text().splitlines())
    assert {"jax", "jaxlib", "jaxlie", "numpy", "networkx", "optimistix", "pytest"} <= set(known)
