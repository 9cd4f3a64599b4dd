"""The page in a browser, where there is one: as wide as a phone, and without an error."""

import json
import re
import shutil
import subprocess

import pytest

from dgae_jax.report import results
from dgae_jax.report.page import page
from tests.report.rows import study, whole

CHROMIUM = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))),
    None,
)

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no chromium is on the PATH")

FRAME = """<!DOCTYPE html><body><iframe src="page.html" style="width: 390px; height: 844px; border: 0" onload="
  const page = this.contentDocument, root = page.documentElement;
  const broken = [...page.images].filter(image => !image.naturalWidth).length;
  document.body.dataset.seen = JSON.stringify([root.clientWidth, root.scrollWidth, page.images.length, broken]);
"></iframe></body>"""
"""A window of a browser cannot be as narrow as a phone, a frame can."""


def seen(text, directory):
    """Width of the viewport and of the page, images, images that are broken; and messages of the console."""
    (directory / "page.html").write_text(text)
    (directory / "frame.html").write_text(FRAME)
    argv = ["--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--allow-file-access-from-files",
            f"--user-data-dir={directory / 'profile'}",
            "--enable-logging=stderr", "--virtual-time-budget=5000", "--dump-dom", (directory / "frame.html").as_uri()]  # fmt: skip
    done = subprocess.run(
        [CHROMIUM, *argv], capture_output=True, text=True, timeout=120, check=True
    )
    numbers = re.search(r'data-seen="([^"]*)"', done.stdout)
    return json.loads(numbers[1]), re.findall(r"CONSOLE.*", done.stderr)


def test_the_page_fits_a_phone_and_the_console_is_silent(tmp_path):
    path = study(tmp_path / "study", whole(("ant", "hopper"), seeds=3))
    text = page([results.read(path)]).replace("<details>", "<details open>")
    (viewport, width, images, broken), messages = seen(text, tmp_path)
    assert (viewport, width) == (390, 390)
    assert (images, broken, messages) == (8, 0, [])


def test_a_page_that_does_not_fit_or_complains_would_be_noticed(tmp_path):
    wide = '<!DOCTYPE html><div style="width: 500px">x</div><img src="data:,"><script>console.error("no")</script>'
    (viewport, width, images, broken), messages = seen(wide, tmp_path)
    assert viewport == 390
    assert width >= 500
    assert (images, broken, len(messages)) == (1, 1, 1)
