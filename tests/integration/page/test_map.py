"""Maps, things and keyframes on the page, in Chromium. Screenshots are kept."""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import expect
from sqlalchemy import text as statement

from tests.browsing import Visit, browser_cpu_ms, visiting
from tests.integration.page.helpers import HOSTILE, READY, TURN, World, address, drawn, opened, viewer


def test_from_a_card_to_a_map_to_a_thing_and_back(visit: Visit, world: World) -> None:
    visit.go("/")
    page = visit.page
    expect(page.locator(".card h2")).to_have_text([HOSTILE, "empty"])
    visit.shot("maps")
    page.locator(".card a").first.click()
    page.wait_for_selector(READY)
    expect(page.locator("h1")).to_have_text(HOSTILE)
    assert page.locator("main img[src=x]").count() == 0
    landmarks = world.database.landmarks(HOSTILE)
    expected = [len(world.database.keyframes(HOSTILE)), len(landmarks)]
    assert viewer(page, "[viewer.scene.keyframes.length, viewer.scene.landmarks.length]") == expected
    assert viewer(page, "viewer.cloud.count") > 1000
    drawn(page)
    visit.shot(f"map-{world.name}")
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


def test_a_keyframe_shows_what_is_seen_in_it(visit: Visit, world: World) -> None:
    keyframe = world.database.keyframes(HOSTILE)[0]
    page = opened(visit, address("maps", HOSTILE, "keyframes", keyframe.id))
    expect(page.locator(".detail h2")).to_have_text(f"Keyframe {keyframe.id}")
    seen = page.locator(".detail section, .detail .row-list").first
    expect(seen.locator("li")).to_have_count(len(keyframe.objects))
    page.get_by_label("Keypoints").check()
    assert "marks=keypoints%2Cobjects" in page.url
    expect(page.locator(".detail")).to_contain_text(f"{len(keyframe.keypoints.features):,} keypoints")
    expect(page.locator(".thumbs li")).to_have_count(min(len(world.database.keyframes(HOSTILE)) - 1, 6))
    drawn(page)
    visit.shot(f"keyframe-{world.name}")
    page.locator(".thumbs a").first.click()
    expect(page.locator(".detail h2")).not_to_have_text(f"Keyframe {keyframe.id}")


def test_a_click_into_space_selects_what_is_there(visit: Visit, world: World) -> None:
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


def test_a_search_flies_there_and_says_what_is_missing(visit: Visit, world: World) -> None:
    landmarks = world.database.landmarks(HOSTILE)
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


def test_every_state_has_an_address(visit: Visit, world: World) -> None:
    page = opened(visit, address("maps", HOSTILE) + "?view=top&off=names,grid")
    assert viewer(page, "[viewer.mode, viewer.hidden.has('grid'), viewer.hidden.has('points')]") == ["top", True, False]
    expect(page.get_by_role("button", name="From above")).to_have_attribute("aria-pressed", "true")
    drawn(page)
    visit.shot(f"above-{world.name}")
    page.keyboard.press("v")
    assert "view=" not in page.url
    page.locator(".layers summary").click()
    page.get_by_label("Points").uncheck()
    assert "points" in page.url
    page.get_by_role("tab", name="Things").focus()
    page.keyboard.press("ArrowRight")
    page.get_by_label("Filter by recording or frame").fill("frame-that-is-none")
    page.wait_for_function("() => location.search.includes('filter=')")
    page.reload()
    page.wait_for_selector(READY)
    assert viewer(page, "[viewer.mode, viewer.hidden.has('points')]") == ["3d", True]
    expect(page.get_by_role("tab", name="Keyframes")).to_have_attribute("aria-selected", "true")
    expect(page.locator(".list-row")).to_have_count(0)
    page.go_back()
    expect(page.get_by_role("tab", name="Things")).to_have_attribute("aria-selected", "true")


def test_back_restores_view_layers_what_is_selected_and_the_place(visit: Visit, world: World) -> None:
    first, second = (item.id for item in world.database.keyframes(HOSTILE)[:2])
    page = opened(visit, world.address("keyframes", first))
    expect(page.locator(".detail h2")).to_have_text(f"Keyframe {first}")
    spot = page.locator(".viewer [role=application]").bounding_box()
    page.mouse.move(spot["x"] + 300, spot["y"] + 300)
    page.mouse.down()
    page.mouse.move(spot["x"] + 380, spot["y"] + 330, steps=4)
    page.mouse.up()
    page.wait_for_function("() => location.search.includes('at=')")
    turned = viewer(page, "viewer.state.position")
    page.locator(f".thumbs a[href*='/keyframes/{second}']").first.click()
    expect(page.locator(".detail h2")).to_have_text(f"Keyframe {second}")
    page.locator(".layers summary").click()
    page.get_by_label("Floor").uncheck()
    page.locator(".viewer [role=application]").focus()
    page.keyboard.press("v")
    page.wait_for_function("() => document.querySelector('.viewer').viewer.mode === 'top'")
    state = "[viewer.mode, viewer.hidden.has('grid')]"
    assert viewer(page, state) == ["top", True]
    page.go_back()
    page.wait_for_function("() => document.querySelector('.viewer').viewer.mode === '3d'")
    assert viewer(page, state) == ["3d", True]
    page.go_back()
    page.wait_for_function("() => !document.querySelector('.viewer').viewer.hidden.has('grid')")
    assert page.get_by_label("Floor").is_checked()
    expect(page.locator(".detail h2")).to_have_text(f"Keyframe {second}")
    page.go_back()
    expect(page.locator(".detail h2")).to_have_text(f"Keyframe {first}")
    assert np.abs(np.array(viewer(page, "viewer.state.position")) - turned).max() < 0.01
    page.go_forward()
    expect(page.locator(".detail h2")).to_have_text(f"Keyframe {second}")


def test_arrows_and_signs_move_the_view(visit: Visit, world: World) -> None:
    page = opened(visit, world.address())
    page.locator(".viewer [role=application]").focus()
    places = [viewer(page, "[...viewer.state.position, ...viewer.state.target]")]
    for key in ("ArrowLeft", "+", "Shift+ArrowUp"):
        page.keyboard.press(key)
        places.append(viewer(page, "[...viewer.state.position, ...viewer.state.target]"))
    assert all(one != other for one, other in itertools.pairwise(places))
    assert "at=" in page.url


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


POINTS = """() => {
    const { viewer } = document.querySelector('.viewer');
    const count = 100_000, [x, y, z] = viewer.extent.centre, wide = 3 * viewer.extent.radius;
    const positions = new Float32Array(3 * count).map((_, k) => [x, y, z][k % 3] + (Math.random() - 0.5) * wide);
    viewer.setPoints({ count, keyframes: 4, positions, colours: new Uint8Array(3 * count).fill(150) });
}"""


def test_a_hundred_thousand_points_are_drawn_in_frames_of_less_than_a_tenth_of_a_second(
    visit: Visit, world: World
) -> None:
    """By the processor. A frame takes the time until the next one or, where other things run, its processor time.

    The better of both and the best of three, as the machine may do other things.
    """
    page = opened(visit, world.address())
    page.evaluate(POINTS)
    drawn(page)
    page.evaluate(TURN, 8)  # what is drawn in a frame follows what the last ones took

    def frames_of(act: Callable[[], None]) -> tuple[float, int]:
        page.evaluate("document.querySelector('.viewer').viewer.painter.frames.length = 0")
        before = browser_cpu_ms()
        act()
        longest, count = viewer(page, "[Math.max(...viewer.frames), viewer.frames.length]")
        return min((browser_cpu_ms() - before) / count, longest), count

    for _ in range(3):
        moving, _ = frames_of(lambda: page.evaluate(TURN, 16))
        resting, pieces = frames_of(lambda: drawn(page))
        print(f"{moving:.0f} ms while it moves, {resting:.0f} ms for each of {pieces} pieces")
        if max(moving, resting) < 100:
            break
    assert viewer(page, "viewer.cloud.count") == 100_000
    assert pieces > 1
    assert max(moving, resting) < 100


@pytest.mark.parametrize("phone", [False, True], ids=["desk", "phone"])
def test_a_map_is_accessible(browser: Any, world: World, phone: bool) -> None:
    for dark in (True, False):
        with visiting(browser, world.url, phone=phone, dark=dark) as visit:
            opened(visit, address("maps", HOSTILE, "landmarks", world.database.landmarks(HOSTILE)[0].id))
            visit.settle()
            visit.check_accessible(f"map, {'dark' if dark else 'light'}")
            visit.shot(f"map-{'phone' if phone else 'desk'}-{'dark' if dark else 'light'}")


def test_a_token_is_asked_for_and_sent_with_images(browser: Any, world: World) -> None:
    token = world.database.create_token("read")
    try:
        with visiting(browser, world.url) as visit:
            visit.expected = ["401"]
            visit.page.goto(visit.url + "/maps")
            visit.page.locator("dialog input").fill(token.secret)
            visit.page.keyboard.press("Enter")
            expect(visit.page.locator(".card h2")).to_have_text([HOSTILE, "empty"])
            visit.page.wait_for_function("() => document.querySelector('.card img')?.src.startsWith('blob:')")
            assert token.secret not in visit.page.content()
    finally:
        world.database.revoke_token(token.token.id)
        with world.database._store().engine.begin() as connection:
            connection.execute(statement("DELETE FROM access_tokens"))
