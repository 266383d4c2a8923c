"""One headless Chromium for the browser tests of a file."""

from __future__ import annotations

import os
import sys

# One thread a process: numpy and torch read this when they are imported, and small matrices lose by
# more of them, badly so when the tests run side by side.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import pytest
from find_browser import MISSING, find_browser


@pytest.fixture(scope="module")
def browser():
    """A headless Chromium; without one the test is skipped, or fails if a browser is required.

    It closes with the file: while Playwright runs, an event loop runs in this thread, and tests
    elsewhere that need a loop of their own would fail.
    """
    required = os.environ.get("CMC_REQUIRE_BROWSER", "0") not in ("", "0")
    absent = pytest.fail if required else pytest.skip
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        absent("Playwright is not installed: pip install cmc[dev]")
    path = find_browser()
    if path is None:
        absent(MISSING)
    # Chromium refuses its sandbox to root, and software rendering stands in for a graphics card.
    root = hasattr(os, "geteuid") and os.geteuid() == 0
    arguments = ["--enable-unsafe-swiftshader", *(["--no-sandbox"] if root else [])]
    with sync_playwright() as playwright:
        running = playwright.chromium.launch(executable_path=path, args=arguments)
        yield running
        running.close()


@pytest.fixture(autouse=True)
def same_draws():
    """Start torch's generator anew for each test, so that its draws depend on no other test."""
    if "torch" in sys.modules:
        sys.modules["torch"].manual_seed(0)
