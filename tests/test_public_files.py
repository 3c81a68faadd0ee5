"""The manifest of public files, and the script that says what is missing."""

import hashlib
import lzma
import re

import public_files
import pytest

COLUMNS = {"file", "repo", "path", "commit", "sha256"}


def test_every_file_has_an_origin():
    rows = public_files.rows()
    assert len({row["file"] for row in rows}) == len(rows) > 60
    for row in rows:
        assert set(row) >= COLUMNS
        assert re.fullmatch(r"[\w.-]+/[\w.-]+", row["repo"]), row
        assert re.fullmatch(r"[0-9a-f]{40}", row["commit"]), row
        assert re.fullmatch(r"[0-9a-f]{64}", row["sha256"]), row
        assert row["path"]
        assert not row["path"].startswith("/")


@pytest.fixture
def manifest(tmp_path):
    digest = hashlib.sha256(b"content").hexdigest()
    lines = ["file\trepo\tpath\tcommit\tsha256"]
    lines += [f"{name}\towner/name\tat/{name}\tabc\t{digest}" for name in ("plain", "packed.xz")]
    path = tmp_path / "manifest.tsv"
    path.write_text("\n".join(lines) + "\n")
    return path


def test_what_is_missing_or_other_is_named_with_its_origin(manifest, tmp_path):
    assert list(public_files.faults(tmp_path, manifest)) == [
        "plain: missing; github.com/owner/name/raw/abc/at/plain",
        "packed.xz: missing; github.com/owner/name/raw/abc/at/packed.xz",
    ]
    (tmp_path / "plain").write_bytes(b"content")
    (tmp_path / "packed.xz").write_bytes(lzma.compress(b"content"))
    assert list(public_files.faults(tmp_path, manifest)) == []
    (tmp_path / "plain").write_bytes(b"other")
    (tmp_path / "packed.xz").write_bytes(b"no archive")
    plain, packed = public_files.faults(tmp_path, manifest)
    assert plain.startswith("plain: differs (d9298a10d1b0); github.com/")
    assert packed.startswith("packed.xz: differs (no xz file); ")


def test_the_files_beside_the_checkout_are_the_manifests(shared_data):
    assert [line for line in public_files.faults(shared_data) if "missing" not in line] == []
