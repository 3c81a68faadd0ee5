"""The sections with figures; the page's scripts draw into them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from pcm_jax.files.account import skipped
from pcm_jax.report._elements import Markup, element, joined
from pcm_jax.report._words import counted, listed, number


def _section(name: str, title: str, how: str, *children: Any) -> Markup:
    return element(
        "section",
        element("h2", title, id=f"{name}-title"),
        element("p", how, class_="how"),
        *children,
        id=name,
        aria_labelledby=f"{name}-title",
    )


def _figure(kind: str, title: str, *notes: Any, **attributes: Any) -> Markup:
    return element(
        "figure",
        element("figcaption", element("h3", title), *notes),
        element("div", class_="drawing", data_draw=kind, **attributes),
    )


def _scrolled(table: Markup, name: str) -> Markup:
    """A table that scrolls by itself where it is wider than the page."""
    return element(
        "div", table, class_="scroll", tabindex="0", role="region", aria_label=f"{name}, table"
    )


def maps_section(drawn: dict[str, Any]) -> Markup:
    """The maps before and after merging, with all closures."""
    names = [robot["name"] for robot in drawn["robots"]]
    before = "Each robot’s own map, apart: how they lie to each other is not known yet."
    figures = [_figure("before", "Before", element("p", before))]
    joint = [k for k, group in enumerate(drawn["groups"]) if len(group) > 1]
    for k in joint:
        inside = listed([names[robot] for robot in drawn["groups"][k]])
        title = "After" if len(joint) == 1 else f"After, group {k + 1}"
        figures.append(
            _figure(
                "after", title, element("p", f"The maps of {inside} in one frame."), data_group=k
            )
        )
    if not joint:
        alone = element("p", "No map was moved: there is no merged map to show.", class_="nothing")
        figures.append(element("figure", element("figcaption", element("h3", "After")), alone))
    thinned = "" if drawn["every"] == 1 else f" One in {drawn['every']} poses is drawn."
    return _section(
        "maps",
        "The maps",
        "A line between two poses is a closure: press one to see why it was accepted or rejected."
        " Drag to move, use the buttons or Ctrl and the wheel to zoom." + thinned,
        element("div", class_="legend", id="legend", role="group", aria_label="Closures drawn"),
        _planes(drawn),
        element("div", *figures, class_="figures"),
    )


def _planes(drawn: dict[str, Any]) -> Markup | None:
    if drawn["space"] == 2:
        return None
    options = [
        element("option", f"{a} – {b}", value=a + b, selected=a + b == drawn["plane"])
        for a, b in ("xy", "xz", "yz")
    ]
    label = element("span", "Plane seen")
    return element(
        "div", element("label", label, element("select", *options, id="plane")), class_="controls"
    )


def agreement_section(drawn: dict[str, Any]) -> Markup | None:
    """Distances between closures, and the graph of those that agree."""
    pairs = drawn["pairs"]
    if not pairs:
        return None
    names = [robot["name"] for robot in drawn["robots"]]
    options = [
        element("option", f"{names[pair['a']]} – {names[pair['b']]}", value=k)
        for k, pair in enumerate(pairs)
    ]
    chooser = element(
        "div",
        element("label", element("span", "Robots"), element("select", *options, id="matrix-pair")),
        class_="controls",
        hidden=len(pairs) < 2,
    )
    return _section(
        "agreement",
        "Who agrees with whom",
        "Every two closures of two robots are compared; the accepted ones are the largest set in"
        " which all pairs agree.",
        chooser,
        element(
            "div",
            _figure(
                "matrix",
                "Distances, ordered by place",
                element(
                    "p",
                    "Row and column are closures in the order in which the robots came to them."
                    " Blue: the two agree; grey: they contradict each other. Bars at the edge mark"
                    " the set that was found (solid) and its rival (split). Press a cell to see its"
                    " two closures.",
                ),
            ),
            _figure(
                "graph",
                "Consistency graph",
                element(
                    "p",
                    "A dot is a closure, a line joins two that agree. A set in which every two are"
                    " joined could be true together. Closures that agree with no other are not"
                    " drawn.",
                ),
            ),
            class_="figures",
        ),
    )


def _rival_figures(
    k: int, pair: dict[str, Any], report: dict[str, Any], drawn: dict[str, Any]
) -> list[Markup]:
    """Two robots' maps by the rival, and by the set found where that was refused."""
    if not pair["alignments"]:
        return []
    a, b = (drawn["robots"][pair[end]]["name"] for end in "ab")
    row = next(row for row in report["robot_pairs"] if (row["a"], row["b"]) == (a, b))
    rival = row["rival"]
    chance = "" if rival["chance"] is None else f", chance p = {number(rival['chance'], 2)}"
    weight = "clearly weaker than the set found"
    if row["ambiguous"]:
        weight = "about as strong as the set found: the answer is ambiguous"
    told = {
        "found": f"{_size(row['found'], row['places'])}; refused.",
        "rival": f"{_size(rival['size'], rival['places'])}{chance}; {weight}.",
    }
    titles = {"found": f"{a} and {b} by the set found", "rival": f"{a} and {b} by the rival"}
    return [
        _figure("rival", titles[by], element("p", told[by]), data_pair=k, data_by=by)
        for by in pair["alignments"]
    ]


def _size(closures: int, places: int) -> str:
    return f"{counted(closures, 'closure')} at {counted(places, 'place')}"


def rivals_section(report: dict[str, Any], drawn: dict[str, Any]) -> Markup | None:
    """The maps put together as the rival set of closures wants it."""
    figures = [
        figure
        for k, pair in enumerate(drawn["pairs"])
        for figure in _rival_figures(k, pair, report, drawn)
    ]
    if not figures:
        return None
    how = (
        "The same two maps, put together by the best set of closures that wants another alignment:"
        " if this map looks right to you, the answer above is wrong."
    )
    if any("found" in pair["alignments"] for pair in drawn["pairs"]):
        how += (
            " Where the set found was refused, the maps are drawn as it would have them as well: if"
            " one of the two looks right to you, merge by its closures."
        )
    return _section(
        "rivals",
        "The rival",
        how,
        element("div", *figures, class_="figures"),
    )


def groups_section(report: dict[str, Any], drawn: dict[str, Any]) -> Markup:
    """Groups, anchors, and how well each map is tied to its group."""
    heads = ("Robot", "Group", "Poses", "Edges", "Anchor", "Place known to")
    leaders = {group[0] for group in report["groups"]}
    group_of = {name: k for k, group in enumerate(report["groups"], 1) for name in group}
    rows = []
    for robot, anchor, tied in zip(
        report["robots"], report["anchors"], drawn["anchors"], strict=True
    ):
        cells = (
            group_of[robot["name"]],
            robot["poses"],
            robot["edges"],
            _anchor(anchor),
            _tie(anchor, tied, leads=robot["name"] in leaders),
        )
        rows.append(
            element(
                "tr",
                element("th", robot["name"], scope="row"),
                *(element("td", cell) for cell in cells),
            )
        )
    table = element(
        "table",
        element("caption", "Groups and anchors", class_="unseen"),
        element("thead", element("tr", *(element("th", name, scope="col") for name in heads))),
        element("tbody", *rows),
    )
    figures = [
        _figure("anchors", f"Group {k + 1}", element("p", "", class_="scale-note"), data_group=k)
        for k, group in enumerate(drawn["groups"])
        if len(group) > 1
    ]
    return _section(
        "groups",
        "Groups and anchors",
        "The anchor is where a map’s own frame lies in its group’s; the ellipse around the middle"
        " of a map holds its true place with 95 % probability.",
        _scrolled(table, "Groups and anchors"),
        element("div", *figures, class_="figures") if figures else None,
    )


def _anchor(anchor: dict[str, float] | None) -> str:
    if anchor is None:
        return "–"
    where = ", ".join(number(anchor[axis]) for axis in "xyz" if axis in anchor)
    turned = (
        anchor["theta"]
        if "theta" in anchor
        else 2.0 * np.arctan2(np.linalg.norm([anchor[q] for q in ("qx", "qy", "qz")]), anchor["qw"])
    )
    return f"({where}) m, turned {number(float(np.degrees(turned)))}°"


def _tie(anchor: dict[str, float] | None, tied: dict[str, Any] | None, *, leads: bool) -> str:
    """The certainty of a map's place in its group."""
    if anchor is None:
        return "by itself"
    if tied is None:
        return "its group’s frame" if leads else "unknown"
    largest = float(np.sqrt(np.linalg.eigvalsh(np.asarray(tied["covariance"])).max()))
    return f"± {number(largest, 2)} m (standard deviation, worst direction)"


def calibration_section(report: dict[str, Any]) -> Markup | None:
    """The factors by which stated errors are off, where they were measured."""
    found = report.get("calibration")
    if not found:
        return None
    rows = [
        element(
            "tr",
            element("th", f"{part}, {kind}", scope="row"),
            element("td", number(_factor(value)), class_="number"),
            element("td", _interval(value)),
        )
        for part in ("odometry", "closures")
        for kind, value in (found.get(part) or {}).items()
        if kind in ("translation", "rotation") and value is not None
    ]
    heads = ("Errors of", "Factor on the information", "90 % interval")
    table = element(
        "table",
        element("caption", "Calibration", class_="unseen"),
        element("thead", element("tr", *(element("th", name, scope="col") for name in heads))),
        element("tbody", *rows),
    )
    plots = [
        _figure("quantiles", str(name), data_plot=name) for name in (found.get("quantiles") or {})
    ]
    advice = found.get("advice")
    return _section(
        "calibration",
        "How honest the stated errors are",
        "A factor of 1: errors are as large as stated; above 1, they are smaller than stated; below"
        " 1, larger.",
        *([element("p", advice)] if isinstance(advice, str) else []),
        _scrolled(table, "Calibration"),
        element("div", *plots, class_="figures") if plots else None,
    )


def _factor(value: Any) -> float | None:
    return value.get("factor") if isinstance(value, Mapping) else value


def _interval(value: Any) -> str:
    interval = value.get("interval") if isinstance(value, Mapping) else None
    return "–" if not interval else f"{number(interval[0])} to {number(interval[1])}"


def making_section(report: dict[str, Any]) -> Markup:
    """The making of the answer: method, gate, version, times."""
    solution = report["solution"]
    facts = {
        "Method": report["method"],
        "Confidence": number(report["confidence"]),
        "Gate γ²": number(report["gate"], 4),
        "Cost": number(solution["cost"], 6),
        "Normalised χ²": number(solution["normalized_chi2"], 4),
        "Solver": f"{'converged' if solution['converged'] else 'NOT converged'} after"
        f" {counted(solution['iterations'], 'step')}",
        "Seconds": ", ".join(f"{name} {number(s, 2)}" for name, s in report["seconds"].items()),
        "Version": f"pcm-jax {report['version']}",
    }
    files = [_file(row) for row in _files(report)]
    if files:
        facts["Files"] = ", ".join(files)
    notes = (report.get("input") or {}).get("notes")
    if notes:
        facts["Of the files"] = "; ".join(notes)
    cycles = [
        f"{' – '.join(cycle['cycle'])}: p = {number(cycle['p'], 2)}" for cycle in report["team"]
    ]
    if cycles:
        facts["Around robots"] = "; ".join(cycles)
    rows = [joined(element("dt", term), element("dd", text)) for term, text in facts.items()]
    return _section(
        "making",
        "How this was made",
        "Settings and measures, to repeat the merge or to report it.",
        element("dl", *rows, class_="making"),
    )


def _file(row: Any) -> str:
    """A file that was read, with the lines of it that were not."""
    if isinstance(row, str):
        return row
    left_out = row.get("left_out")
    return f"{row.get('path', '')} ({skipped(left_out)})" if left_out else str(row.get("path", ""))


def _files(report: dict[str, Any]) -> list[Any]:
    given = report.get("input") or {}
    files = given.get("files") or []
    return list(files)
