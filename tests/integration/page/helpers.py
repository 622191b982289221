"""What tests of the page share."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

from semdb.types import Frame
from tests.browsing import Visit
from tests.serving import Served, png

HOSTILE = "<img src=x onerror=alert(1)> \"quoted\" 'and' right to left: مطبخ &amp;"
WORSE = HOSTILE.replace("right to left", "\u202eright to left\u202c")  # no map may be called so; images may
READY = "html[data-ready=map]"
TURN = """(frames) => new Promise(done => {
    const { viewer } = document.querySelector('.viewer');
    const { state } = viewer;
    let left = frames;
    const step = () => {
        const [x, y, z] = state.position;
        viewer.state = { ...state, position: [x + Math.sin(left / 9), y + Math.cos(left / 9), z] };
        if (--left) requestAnimationFrame(step); else done();
    };
    step();
})"""


@dataclass
class World:
    """A map that is served: `photos` are frames of its recording that are no keyframes."""

    name: str
    map: str
    served: Served
    recording: Path
    photos: list[Frame]
    needs_masks: bool

    @property
    def url(self) -> str:
        return self.served.url

    @property
    def database(self) -> Any:
        return self.served.database

    def address(self, *parts: object, query: str = "") -> str:
        """An address of the page below that of the map."""
        return address("maps", self.map, *parts) + query

    def api(self, *parts: object) -> str:
        return "/v1" + self.address(*parts)


def address(*parts: object) -> str:
    return "/" + "/".join(quote(str(part), safe="") for part in parts)


def opened(visit: Visit, path: str) -> Any:
    """Goes to a map, and waits until its points are there."""
    visit.page.goto(visit.url + path)
    visit.page.wait_for_selector(READY)
    return visit.page


def viewer(page: Any, expression: str) -> Any:
    """Of the space that is shown: an expression of `viewer`."""
    page.wait_for_function("() => document.querySelector('.viewer')?.viewer")
    return page.evaluate(
        f"(() => {{ const viewer = document.querySelector('.viewer').viewer; return {expression}; }})()"
    )


def drawn(page: Any) -> None:
    """Waits until all of the picture is drawn."""
    page.wait_for_function("() => document.querySelector('.viewer')?.viewer?.complete")


def photo_of(frame: Frame) -> bytes:
    """The file of a frame, as it was recorded."""
    return frame.image_bytes or png(frame.image[..., ::-1])


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
