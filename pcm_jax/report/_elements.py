"""HTML elements as text; whatever is not an element itself is escaped."""

from __future__ import annotations

import html
import json
from typing import Any

VOID = frozenset({"br", "input", "link", "meta"})


class Markup(str):
    """Text that is HTML already: all else is escaped where it is put into an element."""

    __slots__ = ()


def element(name: str, /, *children: Any, **attributes: Any) -> Markup:
    """Writes an element.

        element("td", pose_name, data_sort="3.0")

    Args:
        name: of the element.
        *children: elements, or anything else, whose text is escaped; None is left out.
        **attributes: `class_` and `for_` stand for the words of Python, other underscores for
            hyphens; True is an attribute without a value; None and False are left out.
    """
    told = "".join(_attribute(key, value) for key, value in attributes.items())
    if name in VOID:
        return Markup(f"<{name}{told}>")
    return Markup(f"<{name}{told}>{''.join(map(_text, children))}</{name}>")


def joined(*children: Any) -> Markup:
    """Writes elements and text one after another."""
    return Markup("".join(map(_text, children)))


def data(identifier: str, value: Any) -> Markup:
    """Writes JSON for the page's scripts, in which nothing can end the element or open another."""
    text = json.dumps(value, allow_nan=False, separators=(",", ":"), ensure_ascii=True)
    for mark in "<>&":
        text = text.replace(mark, f"\\u{ord(mark):04x}")
    return element("script", Markup(text), type="application/json", id=identifier)


def _text(child: Any) -> str:
    if child is None:
        return ""
    return child if isinstance(child, Markup) else html.escape(str(child), quote=False)


def _attribute(name: str, value: Any) -> str:
    if value is None or value is False:
        return ""
    key = name.rstrip("_").replace("_", "-")
    return f" {key}" if value is True else f' {key}="{html.escape(str(value))}"'
