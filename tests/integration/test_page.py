"""The page of the service in Chromium: each use of it on a small map, one on MySQL. Screenshots are kept.

Nothing but the service is reached, nothing is complained of, axe finds nothing serious.
"""

from __future__ import annotations

import base64
import csv
import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlencode

import numpy as np
import pytest
from playwright.sync_api import expect
from sqlalchemy import text as statement

import semdb
from semdb.database import schema
from semdb.database.engine import make_engine
from semdb.database.store import open_store
from semdb.recordings.synthetic import SyntheticOptions
from semdb.service.settings import ServeSettings
from semdb.types import Frame
from tests.browsing import Visit, chromium, visiting
from tests.integration.opened import opener
from tests.integration.test_changes import stored
from tests.rooms import render
from tests.serving import Served, form_of, png, running

HOSTILE = "<img src=x onerror=alert(1)> \"quoted\" 'and' \u202eright to left\u202c مطبخ &amp;"
ROOM = SyntheticOptions(frames=12, width=320, height=240, lap_frames=40)


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as found:
        yield found


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return render(tmp_path_factory.mktemp("page") / "kitchen", ROOM)


@pytest.fixture(scope="module")
def served(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """The map "office" of a rendered room, and one of made-up rows that changed, whose names are hostile."""
    folder = tmp_path_factory.mktemp("served")
    roots = folder / "roots"
    (roots / "broken").mkdir(parents=True)
    with opener(f"sqlite:///{folder / 'a.sqlite3'}", folder / "cache") as opening:
        database = opening(detector="auto", encoder="auto", features="auto")
        database.ingest(recording, map="office", stride=3)
        database.refine("office", steps=["landmarks"])
        with running(database, ServeSettings(ingest_roots=str(roots))) as found:
            yield found


@pytest.fixture
def visit(browser: Any, served: Served) -> Iterator[Visit]:
    with visiting(browser, served.url) as found:
        yield found


def dropped(visit: Visit, files: dict[str, bytes], where: str = "body") -> None:
    """Drops files onto the page, as a person does."""
    packed = {name: base64.b64encode(content).decode() for name, content in files.items()}
    visit.page.evaluate(
        """([files, where]) => {
            const data = new DataTransfer();
            for (const [name, text] of Object.entries(files))
                data.items.add(new File([Uint8Array.from(atob(text), c => c.charCodeAt(0))], name));
            for (const kind of ["dragenter", "dragover", "drop"])
                document.querySelector(where).dispatchEvent(
                    new DragEvent(kind, {dataTransfer: data, bubbles: true, cancelable: true}));
        }""",
        [packed, where],
    )


def test_a_folder_that_is_chosen_is_localized_photo_by_photo(visit: Visit, recording: Path) -> None:
    page = visit.page
    visit.go("/maps/office/locate")
    page.set_input_files("input[aria-label='A folder']", str(recording))
    page.wait_for_selector("text=/\\d+ of 12 localized/")
    assert page.locator(".result").count() == 12
    assert int(re.findall(r"(\d+) of 12 localized", page.inner_text(".results"))[0]) >= 10
    page.locator(".result").nth(4).click()
    page.wait_for_selector("figure.matches svg path")
    assert page.locator("figure.matches svg path").count() >= 12
    assert "can be relied on" in page.inner_text(".result-detail")
    assert page.locator(".topmap .camera.good").count() == 1
    place = [float(part) for part in page.inner_text(".facts dd >> nth=0").split(",")]
    pose = np.loadtxt(recording / "groundtruth.txt")[4, 1:4]
    assert np.abs(np.array(place) - pose).max() < 0.05
    visit.shot("locate")
    visit.check_accessible("locate")
    page.keyboard.press("j")
    page.wait_for_selector(".result-list li:nth-child(6) .result[aria-current]")


def test_a_photo_that_is_dropped_anywhere_is_localized_without_masks(visit: Visit, recording: Path) -> None:
    photo = sorted((recording / "rgb").iterdir())[2].read_bytes()
    visit.go("/maps/office/queries")
    dropped(visit, {"photo.png": photo})
    visit.page.wait_for_url("**/maps/office/locate")
    visit.page.wait_for_selector("text=1 of 1 localized")
    visit.page.wait_for_selector("figure.matches svg path")
    told = visit.page.inner_text(".result-detail")
    assert "the image has no masks of its own: nothing is filtered by class" in told
    assert "localized without objects" in told
    place = [float(part) for part in visit.page.inner_text(".facts dd >> nth=0").split(",")]
    assert np.abs(np.array(place) - np.loadtxt(recording / "groundtruth.txt")[2, 1:4]).max() < 0.05
    visit.shot("locate-photo")
    dropped(visit, {"notes.txt": b"no photo"})
    visit.page.wait_for_selector("text=There is no PNG or JPEG photo in that.")


def test_the_log_is_filtered_and_each_query_shown(visit: Visit, served: Served, frames_of: list[Frame]) -> None:
    names = ["shelf.png", HOSTILE]
    for k, name in enumerate(names):
        form, files = form_of(frames_of[4 + k], name=name)
        assert served.client.post("/v1/maps/office/localize", data=form, files=files).status_code == 200
    page = visit.page
    visit.go("/maps/office/queries")
    page.wait_for_selector("table.data")
    assert HOSTILE in page.locator("table.data td:nth-child(2)").all_text_contents()
    assert page.locator("main img[src=x]").count() == 0
    visit.shot("queries")
    visit.check_accessible("queries")
    page.fill("[name=text]", "shelf")
    page.press("[name=text]", "Enter")
    page.wait_for_url("**/queries?text=shelf")
    expect(page.locator("table.data tbody tr")).to_have_count(1)
    page.select_option("[name=verdict]", "failed")
    page.wait_for_selector("text=No query of the log is like that")
    page.click("button:has-text('Clear')")
    page.wait_for_selector("td:has-text('shelf.png')")
    page.locator("tr:has-text('shelf.png') a").first.click()
    page.wait_for_url(re.compile(r"/maps/office/queries/\d+"))
    page.wait_for_selector(".topmap .camera.good")
    assert page.locator(".strip li").count() >= 1
    visit.shot("query")
    visit.check_accessible("query")


def test_statements_are_asked_with_the_schema_at_hand(visit: Visit, tmp_path: Path) -> None:
    page = visit.page
    visit.go("/sql")
    page.click(".question:has-text('How many chairs are there')")
    page.wait_for_selector(".sql-out strong")
    assert "landmark_id" in page.inner_text("table.data thead")
    page.fill("#statement", "SELECT keyframe_id, category, x, y, z FROM keyframe_objects WHERE x > -100 LIMIT 7")
    page.press("#statement", "Control+Enter")
    page.wait_for_selector("text=7 rows")
    assert "q=SELECT" in page.url
    page.click("text=Show in the map")
    page.wait_for_selector(".topmap .over .camera")
    visit.shot("sql")
    visit.check_accessible("sql")
    with page.expect_download() as download:
        page.click("button:has-text('CSV')")
    download.value.save_as(tmp_path / "rows.csv")
    with (tmp_path / "rows.csv").open(newline="") as file:
        rows = list(csv.reader(file))
    assert rows[0] == ["keyframe_id", "category", "x", "y", "z"]
    assert len(rows) == 8
    page.fill("#statement", "SELECT 'a' AS \"<b>bold</b>\", NULL AS none")
    page.press("#statement", "Control+Enter")
    page.wait_for_selector("th:has-text('<b>bold</b>')")
    visit.expected.append("422")
    page.fill("#statement", "SELECT a FROM nowhere")
    page.press("#statement", "Control+Enter")
    page.wait_for_selector(".sql-out .failed")
    assert "nowhere" in page.inner_text(".sql-out .failed")
    page.go_back()
    page.wait_for_selector("th:has-text('<b>bold</b>')")


def test_recordings_are_ingested_and_tried_again(visit: Visit, served: Served) -> None:
    page = visit.page
    visit.go("/maps/office/ingest")
    page.wait_for_selector("td:has-text('kitchen')")
    page.click("button[aria-label='Ingest broken']")
    page.wait_for_selector(".job .tag.bad")
    page.click("button[aria-label='Try again: broken']")
    expect(page.locator(".job .tag.bad")).to_have_count(2)
    visit.shot("ingest")
    visit.check_accessible("ingest")
    dropped(visit, {"room.bag": b"#ROSBAG V2.0\n nothing"}, ".drop-zone")
    expect(page.locator(".job .tag.bad")).to_have_count(3)
    assert "room" in page.inner_text(".job >> nth=0")


def test_cameras_move_in_the_map(visit: Visit, served: Served, frames_of: list[Frame]) -> None:
    page = visit.page
    visit.go("/maps/office/live")
    page.wait_for_selector("text=No camera is live in this map")
    session = served.client.post("/v1/maps/office/sessions", json={}).json()
    for k in (4, 5):
        form, files = form_of(frames_of[k], depth=True)
        answer = served.client.post(session["frames"], data=form, files=files)
        assert answer.json()["pose"] is not None, answer.text
    page.wait_for_selector("text=2 frames")
    assert page.locator(".topmap .camera .body").count() == 1
    assert page.locator(".topmap .trail").count() == 1
    visit.shot("live")
    visit.check_accessible("live")
    served.client.delete(session["frames"].removesuffix("/frames"))
    page.wait_for_selector("text=No camera is live in this map")


@pytest.fixture(scope="module")
def frames_of(recording: Path) -> list[Frame]:
    from semdb.recordings import open_recording

    return list(open_recording(recording).frames())


def changed(url: str, folder: Path) -> Any:
    """A database of made-up rows, two recordings of which differ, with a picture for every keyframe."""
    engine = make_engine(url)
    schema.upgrade(engine)
    engine.dispose()
    with open_store(url) as store:
        stored(store)
        picture = png(np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8))
        with store.engine.begin() as connection:
            connection.execute(
                statement("UPDATE keyframe_images SET rgb = :file, rgb_format = 'png'"), {"file": picture}
            )
            connection.execute(statement("UPDATE maps SET name = :name"), {"name": HOSTILE})
    return semdb.open(url, cache_dir=folder, say=lambda line: None)


def looked_at_changes(browser: Any, url: str, database: Any, name: str) -> None:
    with running(database, ServeSettings()) as served, visiting(browser, served.url, dark=False) as visit:
        page = visit.page
        visit.go("/maps")
        page.wait_for_selector("h2")
        assert HOSTILE in page.locator(".card h2").all_text_contents()
        visit.go(f"/maps/{quote(HOSTILE, safe='')}/changes")
        page.wait_for_selector(".change")
        assert page.inner_text(".chip >> nth=1") == "moved 1"
        assert "moved by 500 mm" in page.inner_text(".change >> nth=0") or "0.50 m" in page.inner_text(
            ".change >> nth=0"
        )
        page.click(".chip:has-text('gone')")
        expect(page.locator(".change")).to_have_count(1)
        assert "book" in page.inner_text(".change")
        assert urlencode({"kind": "disappeared"}) in page.url
        visit.shot(name)
        visit.check_accessible(name)


def test_visits_are_compared(browser: Any, tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path / 'a.sqlite3'}"
    looked_at_changes(browser, url, changed(url, tmp_path), "changes")


def test_visits_are_compared_on_mysql(browser: Any, mysql_url: str, tmp_path: Path) -> None:
    looked_at_changes(browser, mysql_url, changed(mysql_url, tmp_path), "changes-mysql")


@pytest.mark.parametrize("dark", [True, False], ids=["dark", "light"])
def test_every_view_is_accessible_on_a_phone_too(browser: Any, served: Served, dark: bool) -> None:
    views = ["maps", "maps/office/locate", "maps/office/queries", "sql", "maps/office/ingest", "maps/office/live"]
    with visiting(browser, served.url, phone=dark, dark=dark) as visit:
        for view in views:
            visit.go(f"/{view}")
            visit.page.wait_for_timeout(400)  # for what comes a little later
            visit.shot(f"{view.replace('/', '-')}-{'phone-dark' if dark else 'light'}")
            visit.check_accessible(view)
            if dark:
                wide = visit.page.evaluate("document.documentElement.scrollWidth - innerWidth")
                assert wide <= 0, f"{view} is {wide} pixels wider than a phone"


def test_the_first_paint_is_soon_and_little_is_sent(browser: Any, served: Served) -> None:
    with visiting(browser, served.url) as visit:
        sent: list[int] = []
        visit.page.on("response", lambda answer: sent.append(int(answer.headers.get("content-length", 0))))
        started = time.monotonic()
        visit.go("/sql")
        paint = visit.page.evaluate("performance.getEntriesByName('first-contentful-paint')[0].startTime")
        assert paint < 3000, (
            f"{paint:.0f} ms, on a machine that does other things too ({time.monotonic() - started:.1f} s)"
        )
        assert sum(sent) < 400_000
