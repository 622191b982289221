"""Takes the pictures of docs/explorer.md from a service of the demonstration's map, after `make demo`.

    SEMDB_SERVE_INGEST_ROOTS=demo-output make serve &
    python scripts/page_pictures.py http://127.0.0.1:8765 demo-output docs/images

Those of changes need two visits of a place, and are not taken. Chromium is that of the tests.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import quote_plus

import cv2
import httpx

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from tests.browsing import Visit, chromium, visiting

STATEMENT = (
    "SELECT category, COUNT(*) AS seen, ROUND(AVG(x), 2) AS x, ROUND(AVG(y), 2) AS y, ROUND(AVG(z), 2) AS z\n"
    "FROM keyframe_objects GROUP BY category ORDER BY seen DESC"
)
DRAWN = """() => {
    const space = document.querySelector('.stage, .viewer'), viewer = document.querySelector('.viewer')?.viewer;
    return !space || (viewer?.cloud && viewer.complete);
}"""
WIDE = {"width": 1280, "height": 800}


def main(url: str, demo: Path, out: Path) -> None:
    photos = sorted((demo / "photos").iterdir())
    with chromium() as browser, visiting(browser, url) as visit, visiting(browser, url, dark=False) as light:
        take = taker(visit, out)
        take("map", "/maps/room")
        take("above", "/maps/room?view=top")
        take("thing", "/maps/room?q=cup+on+dining+table", ".crops img")
        take("keyframe", "/maps/room/keyframes/2", ".thumbs img")
        visit.go("/maps/room/locate")
        visit.page.set_input_files("input[type=file] >> nth=0", [str(path) for path in photos])
        visit.page.wait_for_selector(f"text={len(photos)} of {len(photos)} localized")
        take("locate", None, "figure.matches path", height=1250)
        bright = taker(light, out)
        bright("queries", "/maps/room/queries", "table.data")
        light.go(f"/sql?q={quote_plus(STATEMENT)}")
        light.page.click("text=Show in the map")
        bright("sql", None, ".in-map .topmap", height=1000)
        light.go("/maps/room/ingest")
        light.page.click("button[aria-label='Ingest photos']")  # no recording: what failed is shown
        bright("ingest", None, ".job .tag.bad")
        live(url, demo, visit)
        take("live", None)


def taker(visit: Visit, out: Path) -> Callable[..., None]:
    """What takes a picture of an address, or of what is shown, once all of it is there."""

    def take(name: str, path: str | None, waits: str | None = None, height: int = WIDE["height"]) -> None:
        page = visit.page
        page.set_viewport_size({**WIDE, "height": height})
        if path is not None:
            visit.go(path)
        if waits is not None:
            page.wait_for_selector(waits)
        page.wait_for_function(DRAWN)
        page.wait_for_function("() => [...document.images].every(one => one.complete || one.loading === 'lazy')")
        page.wait_for_timeout(1000)  # flights end, pictures are decoded
        page.wait_for_function(DRAWN)
        page.screenshot(path=str(out / f"explorer-{name}.jpg"), type="jpeg", quality=78)
        print(f"{out / f'explorer-{name}.jpg'}")

    return take


def live(url: str, demo: Path, visit: Visit) -> None:
    """A camera that is tracked through a part of the recording."""
    visit.go("/maps/room/live")
    frames = sorted((demo / "room" / "rgb").iterdir())[20:44]
    with httpx.Client(base_url=url, timeout=60) as client:
        session: Any = client.post("/v1/maps/room/sessions", json={}).json()
        for number, frame in enumerate(frames):
            image = cv2.imencode(".png", cv2.imread(str(frame)))[1].tobytes()
            sent = client.post(session["frames"], data={"time_s": number / 30}, files={"image": ("frame.png", image)})
            sent.raise_for_status()
    visit.page.wait_for_selector(f"text={len(frames)} frames")


if __name__ == "__main__":
    if len(sys.argv) != 4:
        sys.exit(__doc__)
    main(sys.argv[1].rstrip("/"), Path(sys.argv[2]), Path(sys.argv[3]))
