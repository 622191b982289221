"""Chromium for tests of the page: nothing but the service is reached, and what the page complains of fails the test."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import threading
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import REPOSITORY

SCREENSHOTS = REPOSITORY / "browser-output"
AXE = REPOSITORY / "web" / "node_modules" / "axe-core" / "axe.min.js"
PROGRAMS = ("chromium", "chromium-browser", "google-chrome")
MOST_MIB = 3072
DESK, PHONE = {"width": 1280, "height": 800}, {"width": 390, "height": 844}
FLAGS = (
    "--no-sandbox",  # tests may run as root
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-dev-shm-usage",
    "--js-flags=--max-old-space-size=1024",
    "--renderer-process-limit=2",
)
SETTLED = "() => !document.querySelector('.spinner') && document.querySelector('main')?.children.length > 0"
SERIOUS = ("serious", "critical")


def chromium_path() -> str:
    """Where Chromium is; skips where there is none, which is an error where SEMDB_TEST_REQUIRE_CHROMIUM says so."""
    found = os.environ.get("SEMDB_TEST_CHROMIUM") or next(filter(None, map(shutil.which, PROGRAMS)), None)
    if found is None:
        reason = "no chromium here: scripts/install-services.sh installs it, or SEMDB_TEST_CHROMIUM names one"
        if os.environ.get("SEMDB_TEST_REQUIRE_CHROMIUM", "0") not in ("", "0"):
            pytest.fail(reason, pytrace=False)
        pytest.skip(reason)
    return found


@contextlib.contextmanager
def chromium() -> Iterator[Any]:
    """A browser of Playwright, which is killed where it takes more than `MOST_MIB`."""
    from playwright.sync_api import expect, sync_playwright

    expect.set_options(timeout=20_000)
    path = chromium_path()
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=list(FLAGS), timeout=60_000)
        over = threading.Event()
        watcher = threading.Thread(target=_watch, args=(over,), daemon=True)
        watcher.start()
        try:
            yield browser
        finally:
            over.set()
            watcher.join()
            browser.close()


def _watch(over: threading.Event) -> None:
    while not over.wait(1.0):
        pids = _below(os.getpid())
        sizes = {pid: _private_mib(pid) for pid in pids if _name(pid).startswith("chrom")}
        if sum(sizes.values()) > MOST_MIB:
            for pid in sizes:
                with contextlib.suppress(OSError):
                    os.kill(pid, 9)
            return


def browser_cpu_ms() -> float:
    """Processor time that the browser took so far, all its processes: what frames cost, whatever else runs."""
    ticks = 0
    for pid in _below(os.getpid()):
        with contextlib.suppress(OSError, ValueError, IndexError):
            if _name(pid).startswith("chrom"):
                found = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
                ticks += int(found[11]) + int(found[12])
    return 1000 * ticks / os.sysconf("SC_CLK_TCK")


def _below(pid: int) -> list[int]:
    """All processes that came from one."""
    found: list[int] = []
    with contextlib.suppress(OSError):
        for path in Path(f"/proc/{pid}/task").glob("*/children"):
            for child in map(int, path.read_text().split()):
                found += [child, *_below(child)]
    return found


def _name(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/comm").read_text().strip()
    except OSError:
        return ""


def _private_mib(pid: int) -> float:
    try:
        resident, shared = Path(f"/proc/{pid}/statm").read_text().split()[1:3]
    except (OSError, ValueError):
        return 0.0
    return (int(resident) - int(shared)) * 4096 / 2**20


@dataclass
class Visit:
    """A tab of the page. What it said or asked that it should not have is in `complaints`."""

    url: str
    context: Any
    page: Any
    complaints: list[str] = field(default_factory=list)
    expected: list[str] = field(default_factory=list)  # parts of complaints that a test causes on purpose

    def go(self, path: str) -> None:
        """Goes to an address of the page, and waits until it has something to show."""
        self.page.goto(self.url + path, wait_until="load")
        self.settle()

    def settle(self) -> None:
        """Waits until nothing loads any more."""
        self.page.wait_for_function(
            "() => !document.querySelector('.spinner') && document.querySelector('main')?.children.length > 0"
        )

    def shot(self, name: str, what: str | None = None) -> Path:
        """Keeps a screenshot, to be looked at, of the page or of what a selector names."""
        SCREENSHOTS.mkdir(exist_ok=True)
        path = SCREENSHOTS / f"{name}.png"
        (self.page if what is None else self.page.locator(what)).screenshot(path=str(path))
        return path

    def theme(self, name: str) -> None:
        """Dark or light."""
        self.page.emulate_media(color_scheme=name)

    def check_accessible(self, what: str) -> None:
        """No serious finding of axe."""
        if not AXE.exists():
            if os.environ.get("SEMDB_TEST_REQUIRE_NODE", "0") not in ("", "0"):
                pytest.fail("no axe-core, and SEMDB_TEST_REQUIRE_NODE is set: make web/node_modules/.stamp")
            warnings.warn("no axe-core, so nobody looked for what is not accessible: npm ci in web/", stacklevel=2)
            return
        self.page.evaluate(AXE.read_text())
        found = self.page.evaluate(
            "async () => (await axe.run(document, {resultTypes: ['violations']})).violations.map(v =>"
            " ({id: v.id, impact: v.impact, nodes: v.nodes.map(n => n.html.slice(0, 200) + ' ' + n.failureSummary)}))"
        )
        serious = [one for one in found if one["impact"] in SERIOUS]
        assert serious == [], f"{what}: {serious}"

    def check(self) -> None:
        """Nothing was said that was not expected."""
        left = [line for line in self.complaints if not any(part in line for part in self.expected)]
        assert left == []


@contextlib.contextmanager
def visiting(
    browser: Any, url: str, *, phone: bool = False, dark: bool = True, token: str | None = None
) -> Iterator[Visit]:
    """A new tab, whose complaints fail the test in the end."""
    context = browser.new_context(
        viewport=PHONE if phone else DESK,
        color_scheme="dark" if dark else "light",
        reduced_motion="reduce",
        has_touch=phone,
        locale="en",
        timezone_id="UTC",
    )
    context.set_default_timeout(20_000)
    page = context.new_page()
    visit = Visit(url, context, page)

    def refuse(route: Any) -> None:
        visit.complaints.append(f"asked for {route.request.url}")
        route.abort()

    context.route(re.compile(rf"^(?!{re.escape(url)}/|blob:|data:)"), refuse)
    page.on(
        "console",
        lambda message: message.type in ("error", "warning") and visit.complaints.append(f"said {message.text}"),
    )
    page.on("pageerror", lambda error: visit.complaints.append(f"raised {error}"))
    if token is not None:
        context.add_init_script(f"sessionStorage.setItem('semdb.token', {token!r})")
    try:
        yield visit
        visit.check()
    finally:
        context.close()
