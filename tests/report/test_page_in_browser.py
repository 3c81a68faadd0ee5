"""The page in headless Chromium: quiet, alone, usable by mouse and keyboard, in both themes."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from pcm_jax.report import _drawings as drawing

playwright = pytest.importorskip(
    "playwright.sync_api", reason="playwright is not installed; pip install '.[test]' does it"
)

NAMES = "chromium", "chromium-browser", "google-chrome", "chrome"
SIZES = {"phone": (390, 844), "wide": (1280, 860)}
THEMES = "light", "dark"
SERIOUS = "serious", "critical"


@pytest.fixture(scope="module")
def chromium():
    found = next(filter(None, map(shutil.which, NAMES)), None)
    with playwright.sync_playwright() as driver:
        path = found or driver.chromium.executable_path
        if not Path(path).exists():
            pytest.skip("no Chromium: apt-get install chromium, or playwright install chromium")
        browser = driver.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def written(result, hostile, refused, given, spatial, tmp_path_factory):
    """The page of each merge, by name."""
    folder = tmp_path_factory.mktemp("pages")
    merges = {
        "result": result,
        "hostile": hostile,
        "refused": refused,
        "given": given,
        "spatial": spatial,
    }
    for name, merged in merges.items():
        merged.to_html(folder / f"{name}.html")
    return folder


class Opened:
    """A page, and what it said to the console and asked of the network."""

    def __init__(self, context, path, place=""):
        self.page = context.new_page()
        self.said, self.asked = [], []
        self.page.on("console", lambda message: self.said.append(message.text))
        self.page.on("pageerror", lambda error: self.said.append(str(error)))
        self.page.on("dialog", lambda dialog: self.said.append(dialog.message))
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.goto(f"file://{path}{place}")
        self.page.wait_for_selector("html[data-ready]")


@pytest.fixture
def opened(chromium, written):
    """Opens a page of a merge; whatever it says or asks for fails the test."""
    contexts, pages = [], []

    def enter(name="result", size="wide", theme="light", place="", **options):
        width, height = SIZES[size]
        context = chromium.new_context(
            viewport={"width": width, "height": height},
            color_scheme=theme,
            reduced_motion="reduce",
            **options,
        )
        contexts.append(context)
        pages.append(Opened(context, written / f"{name}.html", place))
        return pages[-1].page

    yield enter
    said = [one.said for one in pages]
    asked = [url for one in pages for url in one.asked if not url.startswith(("file:", "data:"))]
    for context in contexts:
        context.close()
    assert not any(said), said
    assert asked == []


def rows(page, attribute="closure"):
    """An attribute of the table's rows, as they stand, those that are shown."""
    return page.eval_on_selector_all(
        "#closures-table tbody tr:not([hidden])",
        f"rows => rows.map(row => row.dataset.{attribute})",
    )


def number_in(page, column):
    """Sort keys of a column, as they stand."""
    return page.eval_on_selector_all(
        f"#closures-table tbody tr td:nth-child({column})",
        "cells => cells.map(cell => Number(cell.dataset.sort))",
    )


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("theme", THEMES)
@pytest.mark.parametrize("name", ["result", "hostile", "refused", "given", "spatial"])
def test_every_page_is_quiet_and_fits(opened, name, size, theme):
    page = opened(name, size, theme)
    assert page.evaluate("document.documentElement.scrollWidth") <= SIZES[size][0]
    drawn = page.eval_on_selector_all(
        "[data-draw]", "hosts => hosts.filter(h => h.querySelector('svg, canvas')).length"
    )
    assert drawn == page.locator("[data-draw]").count() > 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "size", "theme"),
    [
        *(("result", size, theme) for size in SIZES for theme in THEMES),
        *(("refused", "wide", "light"), ("refused", "phone", "dark")),
        *(("spatial", "wide", "dark"), ("spatial", "phone", "light")),
    ],
)
def test_axe_finds_nothing_serious(opened, name, size, theme):
    axe = pytest.importorskip(
        "axe_playwright_python.sync_playwright",
        reason="axe-playwright-python is not installed; pip install '.[test]' does it",
    )
    page = opened(name, size, theme, place="#closure-3")
    found = axe.Axe().run(page).response["violations"]
    told = [(one["id"], [node["target"] for node in one["nodes"]][:3]) for one in found]
    assert [row for row, one in zip(told, found, strict=True) if one["impact"] in SERIOUS] == []


def test_pressing_a_line_tells_its_sentence(opened, result):
    page = opened()
    place = page.evaluate(
        """() => {
            const svg = document.querySelector("[data-draw=after] svg");
            const path = svg.querySelector("path.closure.rival").getAttribute("d");
            const [x, y, u, v] = path.match(/-?[0-9.]+(e-?[0-9]+)?/g).map(Number);
            svg.scrollIntoView({block: "center"});
            const box = svg.getBoundingClientRect();
            return [box.left + x + 0.4 * (u - x), box.top + y + 0.4 * (v - y)];
        }"""
    )
    page.mouse.click(*place)
    title = page.locator("#picked-title").text_content()
    picked = int(title.removeprefix("Closure "))
    row = page.locator(f"#closure-{picked}")
    assert row.get_attribute("class") == "is-picked"
    assert (
        page.locator("#picked-body .sentence").text_content() == row.locator(".why").text_content()
    )
    assert not result.accepted[picked]


@pytest.mark.slow
def test_conflicts_of_a_picked_closure_are_drawn(opened, result):
    page = opened()
    (pair,) = result.selection.pairs
    graph = pair.consistent()
    for closure in np.flatnonzero(~result.accepted)[:4].tolist():
        page.locator(f"#closure-{closure} button").click()
        against = np.flatnonzero(pair.accepted & ~graph[closure]).tolist()
        for kind in ("before", "after"):
            path = page.locator(f"[data-draw={kind}] path.conflict").get_attribute("d") or ""
            assert path.count("M") == len(against) > 0
        named = page.locator("#picked-body .chips").first.locator("button").all_text_contents()
        assert sorted(int(name.split()[1]) for name in named) == against


@pytest.mark.slow
def test_a_closure_named_beside_another_can_be_picked(opened):
    page = opened(place="#closure-3")
    first = page.locator("#picked-body .chip").first
    named = first.text_content().split()[1]
    first.click()
    assert page.locator("#picked-title").text_content() == f"Closure {named}"


@pytest.mark.slow
def test_sorting_by_mouse_and_by_keyboard(opened):
    page = opened()
    assert rows(page) == [str(k) for k in range(20)]
    head = page.locator("#closures-table thead th", has_text="Off by")
    head.locator("button").click()
    off = number_in(page, 7)
    assert off == sorted(off)
    assert len(set(off)) > 10
    assert head.get_attribute("aria-sort") == "ascending"
    head.locator("button").press("Enter")
    assert number_in(page, 7) == sorted(off, reverse=True)
    head.locator("button").press(" ")
    assert number_in(page, 7) == sorted(off)
    page.locator("#closures-table thead th", has_text="Closure").locator("button").click()
    assert [int(k) for k in rows(page)] == list(range(20))
    assert head.get_attribute("aria-sort") is None


@pytest.mark.slow
def test_filtering_by_fate_and_text(opened, result):
    page = opened()
    page.locator("#fate").select_option("accepted")
    assert [int(k) for k in rows(page)] == np.flatnonzero(result.accepted).tolist()
    assert page.locator("#shown").text_content() == "6 of 20 closures shown"
    page.locator("#fate").select_option("")
    page.locator("#find").fill("17")
    assert rows(page) == ["17"]
    page.locator("#find").fill(result.report()["closures"][4]["a"])
    assert "4" in rows(page)
    page.locator("#find").fill("no such thing")
    assert rows(page) == []


def test_fates_can_be_hidden_on_the_maps(opened):
    page = opened()
    assert page.locator("[data-draw=after] path.closure").count() == 3
    page.locator("#legend input[data-fate=rejected]").uncheck()
    assert page.locator("[data-draw=after] path.closure.rejected").count() == 0
    assert page.locator("[data-draw=after] path.closure").count() == 2


@pytest.mark.slow
def test_a_cell_of_the_matrix_tells_its_two_closures(opened, result):
    page = opened()
    (pair,) = result.selection.pairs
    data = json.loads(page.locator("#data").text_content())["pairs"][0]
    canvas = page.locator("[data-draw=matrix] canvas")
    canvas.scroll_into_view_if_needed()
    cell = (canvas.bounding_box()["width"] - 16) / len(data["closures"])
    for row, column in ((2, 9), (11, 4), (data["members"][0], data["members"][1])):
        at = {"x": 16 + (column + 0.5) * cell, "y": 16 + (row + 0.5) * cell}
        canvas.click(position=at)
        u, v = data["closures"][row], data["closures"][column]
        told = page.locator(".readout").text_content()
        word = "agree" if pair.consistent()[u, v] else "contradict each other"
        assert told.startswith(f"Closures {u} and {v} {word}")
        assert page.locator("#picked-title").text_content() == f"Closure {u}"


def test_the_rivals_map_joins_the_rivals_closures(opened):
    page = opened()
    lengths = {
        kind: page.evaluate(
            """kind => {
                const path = document.querySelector(`[data-draw=${kind}] path.closure.rival`);
                const metres = document.querySelector(`[data-draw=${kind}] svg`);
                return path.getTotalLength() / metres.getBoundingClientRect().width;
            }""",
            kind,
        )
        for kind in ("after", "rival")
    }
    assert lengths["rival"] < 0.3 * lengths["after"]


@pytest.mark.slow
def test_moving_through_the_table_and_leaving(opened):
    page = opened()
    page.locator("#fate").select_option("rival")
    shown = rows(page)
    page.locator(f"#closure-{shown[0]} button").click()
    page.locator("#picked-next").click()
    assert page.locator("#picked-title").text_content() == f"Closure {shown[1]}"
    page.locator("#picked-previous").click()
    assert page.locator("#picked-title").text_content() == f"Closure {shown[0]}"
    assert page.locator(f"#closure-{shown[0]} button").get_attribute("aria-pressed") == "true"
    page.keyboard.press("Escape")
    assert page.locator("#picked-title").text_content() == "No closure picked"
    assert page.locator(".is-picked").count() == 0


@pytest.mark.slow
def test_a_link_picks_its_closure(opened):
    page = opened(place="#closure-5")
    assert page.locator("#picked-title").text_content() == "Closure 5"


@pytest.mark.slow
def test_the_theme_follows_the_system_until_it_is_chosen(opened):
    colour = "getComputedStyle(document.body).backgroundColor"
    light, dark = (opened(theme=theme).evaluate(colour) for theme in THEMES)
    assert light != dark
    page = opened(theme="light")
    page.locator("#theme").click()
    assert page.evaluate(colour) == dark
    assert page.locator("#theme").get_attribute("aria-pressed") == "true"
    page.locator("#theme").click()
    assert page.evaluate(colour) == light


@pytest.mark.slow
def test_the_keyboard_reaches_everything(opened):
    page = opened()
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.className") == "skip"
    reached = set()
    for _ in range(90):
        page.keyboard.press("Tab")
        reached.add(page.evaluate("document.activeElement.id || document.activeElement.className"))
    assert {"theme", "find", "fate", "pick", "scroll tall"} <= reached


@pytest.mark.slow
def test_maps_are_zoomed_by_buttons(opened):
    page = opened()
    scene = page.locator("[data-draw=after] .scene")
    figure = page.locator("figure", has=page.locator("[data-draw=after]"))
    figure.get_by_label("Zoom in").click()
    assert scene.get_attribute("transform").endswith("scale(1.6)")
    figure.get_by_label("Show all").click()
    assert scene.get_attribute("transform").endswith("scale(1)")


def test_maps_in_space_are_seen_from_other_sides(opened):
    page = opened("spatial")
    path = page.locator("[data-draw=after] path.robot").first
    seen = {path.get_attribute("d")}
    for plane in ("xz", "yz"):
        page.locator("#plane").select_option(plane)
        seen.add(page.locator("[data-draw=after] path.robot").first.get_attribute("d"))
    assert len(seen) == 3


@pytest.mark.slow
def test_the_worst_conflict_of_the_sentence_is_listed_first(opened, result):
    page = opened()
    rejected = np.flatnonzero(~result.accepted).tolist()
    for closure in rejected:
        worst = result.explain(closure).worst_conflict
        page.evaluate(f"pcm.pick({closure})")
        assert page.locator("#picked-body .chips").first.inner_text().split()[1] == str(worst.index)


@pytest.mark.slow
def test_closures_that_are_not_drawn_are_told(opened, written, result, monkeypatch):
    """In the matrix, in the graph, and beside one of them."""
    monkeypatch.setattr(drawing, "MOST_CLOSURES", 12)
    result.to_html(written / "thinned.html")
    page = opened("thinned")
    told = page.locator("#agreement .thinned").inner_text()
    assert told.startswith("12 of 20 closures are drawn")
    assert told in page.locator("[data-draw=graph] svg").text_content()
    shown = set(page.evaluate("pcm.data.pairs[0].closures"))
    missing = min(set(range(20)) - shown)
    page.evaluate(f"pcm.pick({missing})")
    assert "not among those" in page.locator("#picked-body").inner_text()
    page = opened("result")
    assert page.locator("#agreement .thinned").inner_text() == ""


@pytest.mark.slow
def test_colours_are_those_of_the_theme(opened):
    """What the style sheet says of both themes, and what canvases are painted with."""
    found = {}
    for theme in THEMES:
        page = opened("result", "wide", theme)
        found[theme] = page.evaluate("[pcm.colour('--paper'), pcm.colour('--near')]")
        background = page.evaluate("getComputedStyle(document.body).backgroundColor")
        assert background == found[theme][0]
    assert found["light"] == ["rgb(255, 255, 255)", "rgb(0, 69, 108)"]
    assert found["dark"] == ["rgb(20, 23, 26)", "rgb(184, 226, 250)"]
    page.locator("#theme").click()
    assert page.evaluate("pcm.colour('--paper')") == "rgb(255, 255, 255)"


def test_hostile_names_are_shown_as_they_are(opened, hostile):
    page = opened("hostile")
    names = page.locator("[data-draw=after] .robot-name").all_text_contents()
    assert sorted(names) == sorted(hostile.graph.names)
    page.locator("#closure-2 button").click()
    assert page.locator("img").count() == 0
    assert "</script>:3" in page.locator("#picked-body").text_content()


def test_the_answer_stands_without_scripts(opened, chromium, written, result):
    context = chromium.new_context(java_script_enabled=False)
    page = context.new_page()
    page.goto(f"file://{written / 'result.html'}")
    assert page.locator("h1").is_visible()
    assert page.locator("#closures-table tbody tr").count() == len(result.accepted)
    context.close()


def calibrated(folder, result):
    from pcm_jax.report import write_html

    factors = {"translation": {"factor": 49.8, "interval": [47.0, 53.1]}, "rotation": 100.0}
    quantiles = {"closures": {"expected": [0.5, 1.0, 2.0], "observed": [0.6, 1.1, 2.3]}}
    report = result.report() | {
        "calibration": {
            "odometry": factors,
            "closures": factors,
            "advice": "use --information sqrt",
            "quantiles": quantiles,
        }
    }
    write_html(folder / "calibrated.html", result, report)


def test_calibration_is_shown_where_it_is_known(opened, written, result):
    calibrated(written, result)
    page = opened("calibrated")
    section = page.locator("#calibration")
    assert "49.8" in section.text_content()
    assert "47 to 53.1" in section.text_content()
    assert "use --information sqrt" in section.text_content()
    assert section.locator("svg path.ends").get_attribute("d").count("M") == 3
