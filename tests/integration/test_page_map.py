"""Maps, things and keyframes on the page, in Chromium; a large map in the long tests. Screenshots are kept."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pytest
from playwright.sync_api import expect
from sqlalchemy import text as statement

from semdb.recordings.synthetic import SyntheticOptions
from semdb.service.settings import ServeSettings
from tests.browsing import Visit, chromium, visiting
from tests.integration.opened import opener
from tests.rooms import render
from tests.serving import Served, running

HOSTILE = "<img src=x onerror=alert(1)> \"quoted\" 'and' right to left: مطبخ &amp;"
ROOM = SyntheticOptions(frames=12, width=320, height=240, lap_frames=40)
READY = "html[data-ready=map]"
LARGE = 10_000


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as found:
        yield found


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """A map of four keyframes with landmarks, of a hostile name, and an empty one."""
    folder = tmp_path_factory.mktemp("served")
    room = render(tmp_path_factory.mktemp("map") / "room", ROOM)
    with opener(f"sqlite:///{folder / 'a.sqlite3'}", folder / "cache") as opening:
        database = opening(detector="auto", encoder="auto", features="auto")
        database.ingest(room, map=HOSTILE, stride=3)
        database.refine(HOSTILE, steps=["landmarks"])
        database._store().ensure_map("empty")
        with running(database, ServeSettings()) as found:
            yield found


@pytest.fixture
def visit(browser: Any, served: Served) -> Iterator[Visit]:
    with visiting(browser, served.url) as found:
        yield found


def address(*parts: object) -> str:
    return "/" + "/".join(quote(str(part), safe="") for part in parts)


def opened(visit: Visit, path: str) -> Any:
    """Goes to a map, and waits until its points are drawn."""
    visit.page.goto(visit.url + path)
    visit.page.wait_for_selector(READY)
    return visit.page


def viewer(page: Any, expression: str) -> Any:
    return page.evaluate(
        f"(() => {{ const viewer = document.querySelector('.viewer').viewer; return {expression}; }})()"
    )


def test_from_a_card_to_a_map_to_a_thing_and_back(visit: Visit, served: Served) -> None:
    visit.go("/")
    page = visit.page
    expect(page.locator(".card h2")).to_have_text([HOSTILE, "empty"])
    visit.shot("maps")
    page.locator(".card a").first.click()
    page.wait_for_selector(READY)
    expect(page.locator("h1")).to_have_text(HOSTILE)
    assert page.locator("main img[src=x]").count() == 0
    landmarks = served.database.landmarks(HOSTILE)
    drawn = [len(served.database.keyframes(HOSTILE)), len(landmarks)]
    assert viewer(page, "[viewer.scene.keyframes.length, viewer.scene.landmarks.length]") == drawn
    assert viewer(page, "viewer.cloud.count") > 1000
    visit.shot("map")
    first = page.locator(".list-row").first
    category = str(first.locator("bdi").text_content())
    first.click()
    expect(page.locator(".detail h2 bdi")).to_have_text(category)
    page.wait_for_function("() => document.querySelector('.crops img')?.naturalWidth > 0")
    assert re.search(r"/landmarks/\d+", page.url)
    expect(page.locator(".detail")).to_contain_text("SQL")
    visit.shot("thing")
    page.keyboard.press("Escape")
    expect(page.locator(".detail")).to_be_hidden()
    page.go_back()
    expect(page.locator(".detail h2 bdi")).to_have_text(category)


def test_a_keyframe_shows_what_is_seen_in_it(visit: Visit, served: Served) -> None:
    keyframe = served.database.keyframes(HOSTILE)[0]
    page = opened(visit, address("maps", HOSTILE, "keyframes", keyframe.id))
    expect(page.locator(".detail h2")).to_have_text(f"Keyframe {keyframe.id}")
    seen = page.locator(".detail section, .detail .row-list").first
    expect(seen.locator("li")).to_have_count(len(keyframe.objects))
    page.get_by_label("Keypoints").check()
    expect(page.locator(".detail")).to_contain_text(f"{len(keyframe.keypoints.features):,} keypoints")
    expect(page.locator(".thumbs li")).to_have_count(len(served.database.keyframes(HOSTILE)) - 1)
    visit.shot("keyframe")
    page.locator(".thumbs a").first.click()
    expect(page.locator(".detail h2")).not_to_have_text(f"Keyframe {keyframe.id}")


def test_a_click_into_space_selects_what_is_there(visit: Visit, served: Served) -> None:
    page = opened(visit, address("maps", HOSTILE) + "?off=landmarks,names")
    spot = viewer(
        page,
        """(() => {
        const item = viewer.scene.keyframes[2];
        const v = viewer.camera.position.clone().set(...item.position).project(viewer.camera);
        const box = viewer.canvas.getBoundingClientRect();
        return [item.id, box.x + (v.x + 1) / 2 * box.width, box.y + (1 - v.y) / 2 * box.height]; })()""",
    )
    page.mouse.click(*spot[1:])
    expect(page.locator(".detail h2")).to_contain_text("Keyframe")
    assert "off=landmarks" in page.url


def test_a_search_flies_there_and_says_what_is_missing(visit: Visit, served: Served) -> None:
    landmarks = served.database.landmarks(HOSTILE)
    wanted = next(one.category for one in landmarks if one.state != "gone")
    page = opened(visit, address("maps", HOSTILE))
    before = viewer(page, "viewer.state.position")
    page.keyboard.press("/")
    page.keyboard.type(wanted)
    page.keyboard.press("Enter")
    expect(page.locator(".detail h2 bdi")).to_have_text(wanted)
    assert viewer(page, "viewer.state.position") != before
    page.reload()
    page.wait_for_selector(READY)
    expect(page.locator(".results")).to_contain_text("hit")
    page.locator(".search input").fill("elephant")
    page.keyboard.press("Enter")
    expect(page.locator(".miss")).to_contain_text("never seen")
    visit.shot("search")


def test_every_state_has_an_address(visit: Visit) -> None:
    page = opened(visit, address("maps", HOSTILE) + "?view=top&off=names,grid")
    assert viewer(page, "[viewer.mode, viewer.hidden.has('grid'), viewer.hidden.has('points')]") == ["top", True, False]
    expect(page.get_by_role("button", name="From above")).to_have_attribute("aria-pressed", "true")
    visit.shot("above")
    page.keyboard.press("v")
    assert "view=" not in page.url
    page.locator(".layers summary").click()
    page.get_by_label("Points").uncheck()
    assert "points" in page.url
    page.reload()
    page.wait_for_selector(READY)
    assert viewer(page, "[viewer.mode, viewer.hidden.has('points')]") == ["3d", True]


def test_what_is_empty_or_not_there_says_what_to_do(visit: Visit) -> None:
    visit.expected = ["404"]
    visit.go("/maps/empty")
    expect(visit.page.locator("main")).to_contain_text("semdb ingest FOLDER")
    visit.go("/maps/attic")
    expect(visit.page.locator(".failed")).to_contain_text("attic")
    visit.go(address("maps", HOSTILE, "landmarks", 99999))
    expect(visit.page.locator(".detail")).to_contain_text("no thing 99999")
    visit.go("/nothing/here")
    expect(visit.page.locator("h1")).to_have_text("There is nothing at this address")


@pytest.mark.parametrize("phone", [False, True], ids=["desk", "phone"])
def test_a_map_is_accessible(browser: Any, served: Served, phone: bool) -> None:
    for dark in (True, False):
        with visiting(browser, served.url, phone=phone, dark=dark) as visit:
            opened(visit, address("maps", HOSTILE, "landmarks", served.database.landmarks(HOSTILE)[0].id))
            visit.settle()
            visit.check_accessible(f"map, {'dark' if dark else 'light'}")
            visit.shot(f"map-{'phone' if phone else 'desk'}-{'dark' if dark else 'light'}")


def test_a_token_is_asked_for_and_sent_with_images(browser: Any, served: Served) -> None:
    token = served.database.create_token("read")
    try:
        with visiting(browser, served.url) as visit:
            visit.expected = ["401"]
            visit.page.goto(visit.url + "/maps")
            visit.page.locator("dialog input").fill(token.secret)
            visit.page.keyboard.press("Enter")
            expect(visit.page.locator(".card h2")).to_have_text([HOSTILE, "empty"])
            visit.page.wait_for_function("() => document.querySelector('.card img')?.src.startsWith('blob:')")
            assert token.secret not in visit.page.content()
    finally:
        served.database.revoke_token(token.token.id)
        with served.database._store().engine.begin() as connection:
            connection.execute(statement("DELETE FROM access_tokens"))


@pytest.mark.long
def test_ten_thousand_keyframes_and_things_stay_usable(browser: Any, tmp_path: Path) -> None:
    room = render(tmp_path / "room", ROOM)
    with opener(f"sqlite:///{tmp_path / 'a.sqlite3'}", tmp_path / "cache") as opening:
        database = opening(detector="auto", encoder="auto", features="auto")
        database.ingest(room, map="large", stride=3)
        database.refine("large", steps=["landmarks"])
        for table, moved in (("keyframes", ("tx", "ty")), ("landmarks", ("x", "y"))):
            _multiply(database, table, moved)
        with running(database, ServeSettings()) as served, visiting(browser, served.url) as visit:
            page = opened(visit, "/maps/large")
            assert viewer(page, "[viewer.scene.keyframes.length, viewer.scene.landmarks.length]") == [LARGE, LARGE]
            rows = page.locator(".list-row")
            assert rows.count() < 60
            page.locator(".list").evaluate("list => { list.scrollTop = list.scrollHeight; }")
            expect(page.locator(f'.list-row[data-index="{LARGE - 1}"]')).to_be_visible()
            took = page.evaluate("""() => {
                const input = document.querySelector('.panel-filter input');
                input.value = 'c';
                const began = performance.now();
                input.dispatchEvent(new Event('input'));
                return performance.now() - began; }""")
            assert took < 1000, f"{took} ms"
            page.locator(".list-row").first.click()
            expect(page.locator(".detail h2")).to_be_visible()
            visit.shot("large")


def _multiply(database: Any, table: str, moved: tuple[str, str]) -> None:
    """Copies rows of a table until there are `LARGE`, each moved a little."""
    with database._store().engine.begin() as connection:
        rows = [dict(row._mapping) for row in connection.execute(statement(f"SELECT * FROM {table}"))]
        last = max(row["id"] for row in rows)
        made = []
        for number in range(LARGE - len(rows)):
            row = dict(rows[number % len(rows)])
            row["id"] = last + 1 + number
            if "frame_index" in row:
                row["frame_index"] = 100_000 + number
            for axis, name in enumerate(moved):
                row[name] += (number * (7919, 104_729)[axis] % 6000) / 100 - 30
            made.append(row)
        names = ", ".join(made[0])
        values = ", ".join(f":{name}" for name in made[0])
        connection.execute(statement(f"INSERT INTO {table} ({names}) VALUES ({values})"), made)
