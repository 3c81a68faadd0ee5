"""`python -m benchmarks.pictures`: what `pcm-jax demo` draws, into this folder.

The picture as it is; of the page its first screen and the maps, by Chromium (Playwright), with a
closure picked that PCM rejected. Without a browser the page is left as it was.
"""

from __future__ import annotations

import contextlib
import io
import shutil
import tempfile
from contextlib import chdir
from pathlib import Path

from PIL import Image

from pcm_jax.cli import main as pcm_jax
from pcm_jax.cli._arguments import DEMO_PAGE, DEMO_PICTURE

HERE = Path(__file__).parent
PICTURE, PAGE = HERE / "demo.png", HERE / "page.png"
COLOURS = 128  # enough for lines and letters; a sixth of the file's size
WIDE, HIGH = 1280, 1330
PICKED = 17


def main(target: Path = PICTURE, page: Path | None = None) -> None:
    """Runs the demo as a user does, and keeps what it draws with fewer colours."""
    with tempfile.TemporaryDirectory() as folder, chdir(folder):
        pcm_jax(["demo"])
        _kept(Image.open(DEMO_PICTURE), target)
        browser = shutil.which("chromium") or shutil.which("chromium-browser")
        if page is not None and browser is not None:
            _kept(Image.open(io.BytesIO(_screen(Path(DEMO_PAGE).resolve(), browser))), page)


def _kept(drawn: Image.Image, target: Path) -> None:
    drawn.convert("RGB").quantize(COLOURS).save(target, optimize=True)


def _screen(page: Path, browser: str) -> bytes:
    """A screenshot of the page, one of its rejected closures picked."""
    with contextlib.ExitStack() as scopes:
        from playwright.sync_api import sync_playwright

        playwright = scopes.enter_context(sync_playwright())
        chromium = playwright.chromium.launch(executable_path=browser, args=["--no-sandbox"])
        shown = chromium.new_page(viewport={"width": WIDE, "height": HIGH})
        shown.goto(page.as_uri())
        shown.click(f"#closures-table tr[data-closure='{PICKED}'] button")
        shown.evaluate("window.scrollTo(0, 0)")
        shown.wait_for_timeout(500)
        picture = shown.screenshot()
        chromium.close()
    return picture


if __name__ == "__main__":
    main(page=PAGE)
