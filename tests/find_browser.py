"""Find a Chromium for the browser tests; with --install, get one where there is none.

In turn: a Chromium or Chrome on the PATH, the one Playwright keeps, Playwright's download, and, as
root on Debian or Ubuntu, the distribution's package.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
MISSING = (
    "The browser checks need Chromium or Chrome, and none could be installed: install one "
    "(on Debian and Ubuntu: apt install chromium), then run make test again."
)


def find_browser() -> str | None:
    """Path of an installed Chromium or Chrome, or None."""
    for name in NAMES:
        if found := shutil.which(name):
            return found
    try:
        from playwright.sync_api import sync_playwright

        with sync_playwright() as playwright:
            path = playwright.chromium.executable_path
    except Exception:  # no driver for this platform: the same as no browser
        return None
    return path if Path(path).exists() else None


def install_browser() -> str | None:
    """Try Playwright's download, then apt as root; return the path found afterwards."""
    attempts = [[sys.executable, "-m", "playwright", "install", "chromium-headless-shell"]]
    if shutil.which("apt-get") and os.geteuid() == 0:
        attempts = [
            ["apt-get", "update", "-qq"],
            ["apt-get", "install", "-y", "-qq", "--no-install-recommends", "chromium"],
            *attempts,
        ]
    for command in attempts:
        subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, check=False)
        if command[1] != "update" and (found := find_browser()):
            return found
    return None


def main(arguments: list[str]) -> int:
    """Print the browser that the tests will use."""
    found = find_browser() or ("--install" in arguments and install_browser()) or None
    print(f"Browser for the checks: {found}" if found else MISSING)
    return 0 if found else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
