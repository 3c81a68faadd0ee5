"""The first screen: the answer in words, how sure it is, and what each pair of robots says."""

from __future__ import annotations

from typing import Any

from pcm_jax.report._elements import Markup, element, joined
from pcm_jax.report._words import answer, counted, headline, number

GLOSSARY = (
    (
        "A closure",
        "is a measurement between two robots: “this pose of mine saw that pose of yours, so far"
        " away and turned so much”. Many are false, because two places look alike.",
    ),
    (
        "Two closures agree",
        "if going round the loop that they make with the two maps leads back to the start, up to"
        " the uncertainty of maps and measurements.",
    ),
    (
        "Sigma",
        "is one standard deviation: how far a loop of two right closures misses by noise alone."
        " Three sigmas are rare; a hundred are no noise.",
    ),
    (
        "Accepted",
        "is the largest set in which every two agree, if it is too large for chance and no other"
        " set explains the maps about as well. Everything else is rejected.",
    ),
)


def answer_section(report: dict[str, Any]) -> Markup:
    """The answer, its figures, warnings and the table of robot pairs."""
    told = [*report.get("warnings", []), *report.get("hints", [])]
    return element(
        "section",
        element("h1", headline(report), id="answer-title"),
        element("p", " ".join(answer(report)), class_="lead"),
        _warnings(told),
        element("dl", *_cards(report), class_="cards"),
        _glossary(),
        _pairs(report["robot_pairs"]),
        id="answer",
        aria_labelledby="answer-title",
    )


def _warnings(told: list[str]) -> Markup | None:
    if not told:
        return None
    rows = [element("li", element("strong", "Look at this: "), text) for text in told]
    return element("ul", *rows, class_="warnings")


def _card(term: str, value: Any, note: str, state: str = "plain") -> Markup:
    return element(
        "div",
        element("dt", term),
        element("dd", value, class_="value"),
        element("dd", note, class_="note"),
        class_=f"card {state}",
    )


def _cards(report: dict[str, Any]) -> list[Markup]:
    total, kept = len(report["closures"]), sum(r["accepted"] for r in report["closures"])
    groups = [" + ".join(group) for group in report["groups"]]
    cards = [
        _card("Accepted closures", f"{kept} of {total}", f"by {report['method']}"),
        _card(
            counted(len(groups), "map frame"),
            groups[0] if len(groups) == 1 else " | ".join(groups),
            "one group: all maps are in one frame"
            if len(groups) == 1
            else "groups that nothing joins keep frames of their own",
        ),
        _chance(report["robot_pairs"]),
        _rival(report["robot_pairs"]),
        _proof(report["robot_pairs"]),
        _fit(report["solution"]),
    ]
    return [card for card in cards if card]


def _chance(pairs: list[dict[str, Any]]) -> Markup | None:
    known = [pair for pair in pairs if pair.get("chance") is not None]
    if not known:
        return None
    merged = [pair["chance"] for pair in known if pair["accepted"]]
    note = "how often closures of which none is right would agree as well"
    if merged:
        return _card("Chance", f"p = {number(max(merged), 2)}", note, "good")
    least = min(pair["chance"] for pair in known)
    return _card("Chance", f"p = {number(least, 2)}", note, "bad" if least > 0.01 else "plain")


def _rival(pairs: list[dict[str, Any]]) -> Markup | None:
    if all(pair.get("found") is None for pair in pairs):
        return None
    rivals = [pair for pair in pairs if pair.get("rival")]
    ambiguous = [pair for pair in rivals if pair["ambiguous"]]
    if ambiguous:
        many = f"in {len(ambiguous)} of {len(pairs)} robot pairs" if len(pairs) > 1 else "ambiguous"
        note = "another set of closures explains the maps about as well, by another alignment"
        return _card("Rival", f"Yes, {many}", note, "bad")
    if rivals:
        size = max(pair["rival"]["size"] for pair in rivals)
        note = "the best set that implies another alignment is clearly weaker"
        return _card("Rival", f"Weak: {counted(size, 'closure')}", note, "good")
    state = "good" if any(pair["accepted"] for pair in pairs) else "plain"
    return _card("Rival", "None", "no other set of closures implies another alignment", state)


def _proof(pairs: list[dict[str, Any]]) -> Markup | None:
    known = [pair["optimal"] for pair in pairs if pair.get("optimal") is not None]
    if not known:
        return None
    if all(known):
        note = "no larger set of closures exists in which every two agree"
        return _card("Largest set", "Proven", note, "good")
    note = "the search ended before a larger set was ruled out: give it more time"
    return _card("Largest set", f"Not proven for {known.count(False)} of {len(known)}", note, "bad")


def _fit(solution: dict[str, Any]) -> Markup:
    chi2 = solution["normalized_chi2"]
    if not solution["converged"]:
        return _card("Fit", "Not converged", "the merged map is not at its optimum", "bad")
    if chi2 is None:
        return _card("Fit", "–", "no measurement is left over to judge the fit by")
    state = "good" if 0.3 < chi2 < 3.0 else "plain"
    return _card("Fit", f"χ² = {number(chi2)}", "normalised: 1 if errors are as stated", state)


def _glossary() -> Markup:
    rows = [element("p", element("dfn", term), " ", text) for term, text in GLOSSARY]
    return element("div", *rows, class_="glossary", role="note", aria_label="Words used here")


def _pairs(pairs: list[dict[str, Any]]) -> Markup:
    heads = (
        ("Robots", None),
        ("Measured", "number"),
        ("Accepted", "number"),
        ("Places", "number"),
        ("Chance p", "number"),
        ("Rival", None),
        ("Largest set", None),
        ("All together, p", "number"),
        ("Why", None),
    )
    head = element("tr", *(element("th", name, scope="col", class_=kind) for name, kind in heads))
    return joined(
        element("h2", "Robot by robot", class_="minor"),
        element(
            "p",
            "One row for each two robots that closures join. Places counts witnesses: closures next"
            " to each other along both ways count once. All together: whether all accepted"
            " closures can be right at once (small is doubtful).",
            class_="how",
        ),
        element(
            "div",
            element(
                "table",
                element("caption", "What each pair of robots says", class_="unseen"),
                element("thead", head),
                element("tbody", *map(_pair_row, pairs)),
            ),
            class_="scroll",
            tabindex="0",
            role="region",
            aria_label="Robot by robot, table",
        ),
    )


def _pair_row(pair: dict[str, Any]) -> Markup:
    rival, joint = pair.get("rival"), pair.get("joint")
    told = f"{rival['size']}{', ambiguous' if pair['ambiguous'] else ', weaker'}" if rival else "–"
    cells = (
        (pair["measured"], "number"),
        (pair["accepted"], "number"),
        (_or_dash(pair.get("places")), "number"),
        (number(pair.get("chance"), 2), "number"),
        (told, None),
        (certificate(pair), None),
        (number(joint and joint["p"], 2), "number"),
        (pair.get("why") or "–", "why"),
    )
    return element(
        "tr",
        element("th", f"{pair['a']} – {pair['b']}", scope="row"),
        *(element("td", text, class_=kind) for text, kind in cells),
    )


def certificate(pair: dict[str, Any]) -> str:
    """Says whether the largest consistent set of two robots' closures is known."""
    if pair.get("optimal") is None:
        return "not looked for"
    if pair["optimal"]:
        return "proven"
    bound = pair.get("weight_bound")
    return f"not proven, at most {f'weight {bound:.6g}' if bound else pair['upper_bound']}"


def _or_dash(value: Any) -> Any:
    return "–" if value is None else value
