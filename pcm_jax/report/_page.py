"""The document: sections, data, style and scripts in one file that asks for nothing else.

The page's policy (Content-Security-Policy) names its style and its scripts by their hashes and
forbids all else, requests above all.
"""

from __future__ import annotations

import base64
import hashlib
import json
from importlib.resources import files
from typing import Any

from pcm_jax.merging import MergeResult
from pcm_jax.report._answer import answer_section
from pcm_jax.report._closures import closures_section
from pcm_jax.report._drawings import drawings
from pcm_jax.report._elements import Markup, data, element
from pcm_jax.report._facts import facts_of
from pcm_jax.report._sections import (
    agreement_section,
    calibration_section,
    groups_section,
    making_section,
    maps_section,
    rivals_section,
)
from pcm_jax.report._words import headline

SCRIPTS = ("state", "figure", "maps", "agreement", "calibration", "table", "page")
"""The page's own scripts, in the order in which they run."""
NOTHING_PICKED = (
    "Press a line on a map, a dot or a cell of the figures, or a number in the table: here it says"
    " why that closure was accepted or rejected."
)
TITLES = {
    "answer": "Answer",
    "maps": "Maps",
    "closures": "Closures",
    "agreement": "Agreement",
    "rivals": "Rival",
    "groups": "Groups",
    "calibration": "Calibration",
    "making": "Making",
}


def page(result: MergeResult, report: dict[str, Any]) -> str:
    """Writes the page on a merge.

    Args:
        result: of `merge`.
        report: of `MergeResult.report`, with whatever else is known.
    """
    facts = facts_of(result)
    drawn = drawings(result, facts, report["closures"])
    if report.get("calibration"):
        drawn["quantiles"] = report["calibration"].get("quantiles")
    sections = {
        "answer": answer_section(report),
        "maps": maps_section(drawn),
        "closures": closures_section(result, report, facts),
        "agreement": agreement_section(drawn),
        "rivals": rivals_section(report, drawn),
        "groups": groups_section(report, drawn),
        "calibration": calibration_section(report),
        "making": making_section(report),
    }
    shown = {name: section for name, section in sections.items() if section is not None}
    first, *others = shown.values()
    work = element("div", element("div", *others), _picked(), class_="work")
    body = element(
        "body",
        element("a", "To the answer", href="#answer", class_="skip"),
        _top(list(shown)),
        element("main", first, work, id="main"),
        data("data", drawn),
        *_scripts(),
    )
    head = element(
        "head",
        Markup('<meta charset="utf-8">'),
        element("meta", http_equiv="Content-Security-Policy", content=_policy()),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("meta", name="color-scheme", content="light dark"),
        element("meta", name="generator", content=f"pcm-jax {report['version']}"),
        element("link", rel="icon", href="data:,"),
        element("title", f"{headline(report)} – pcm-jax"),
        element("style", _style()),
    )
    return f"<!DOCTYPE html>\n{element('html', head, body, lang='en')}\n"


def _top(names: list[str]) -> Markup:
    links = [element("li", element("a", TITLES[name], href=f"#{name}")) for name in names]
    return element(
        "header",
        element("p", "pcm-jax", element("span", " merge report"), class_="brand"),
        element("nav", element("ul", *links), aria_label="Sections"),
        element("button", "Dark", type="button", id="theme", aria_pressed="false"),
        class_="top",
    )


def _picked() -> Markup:
    """The closure that was picked: what the page says of it, and whom it contradicts."""
    buttons = [
        element("button", text, type="button", id=f"picked-{name}", aria_label=label)
        for name, text, label in (
            ("previous", "‹", "Previous closure of the table"),
            ("next", "›", "Next closure of the table"),
            ("close", "✕", "Close"),
        )
    ]
    return element(
        "aside",
        element(
            "div",
            element("h2", "No closure picked", id="picked-title"),
            element("div", *buttons, class_="buttons"),
            class_="bar",
        ),
        element("div", element("p", NOTHING_PICKED), id="picked-body", aria_live="polite"),
        id="picked",
        class_="is-empty",
        aria_labelledby="picked-title",
    )


def vendored() -> list[dict[str, str]]:
    """The libraries that every page carries, as `vendor/vendored.json` lists them."""
    return json.loads(_text("vendor", "vendored.json"))


def _text(folder: str, name: str) -> str:
    return (files("pcm_jax.report") / folder / name).read_text(encoding="utf-8")


def _style() -> Markup:
    return Markup(_text("page", "page.css"))


def _sources() -> list[str]:
    """The scripts' texts: each library under its licence, then the page's own."""
    found, licences = [], set()
    for entry in vendored():
        licence = ""
        if entry["licence_file"] not in licences:
            licence = _text("vendor", entry["licence_file"]).replace("*/", "* /")
            licence = f"{entry['name']} {entry['version']} ({entry['licence']})\n{licence}"
            licences.add(entry["licence_file"])
        found.append(
            f"/*! {licence}*/\n{_text('vendor', entry['file'])}"
            if licence
            else _text("vendor", entry["file"])
        )
    own = "\n".join(_text("page", f"{name}.js") for name in SCRIPTS)
    return [*found, own]


def _scripts() -> list[Markup]:
    return [element("script", Markup(source)) for source in _sources()]


def _policy() -> str:
    scripts = " ".join(map(_hash, _sources()))
    return (
        f"default-src 'none'; script-src {scripts}; style-src {_hash(_style())}; img-src data:;"
        " base-uri 'none'; form-action 'none'"
    )


def _hash(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
