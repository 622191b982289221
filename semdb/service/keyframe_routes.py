"""Keyframes: files as recorded, objects, masks, keypoints."""

from __future__ import annotations

import io
from typing import Annotated, Any

import numpy as np
from fastapi import Query, Request
from starlette.responses import Response

from semdb.api import Database
from semdb.door.values import Keyframe, encode
from semdb.service import schemas, values
from semdb.service.answers import encoded, tagged
from semdb.service.problems import Problem, not_found
from semdb.service.roles import READ
from semdb.service.routing import KeyframeId, Table
from semdb.service.state import access_of, draw, read

table = Table("keyframes")
MEDIA = {"png": "image/png", "jpeg": "image/jpeg"}
_FILE = {"schema": {"type": "string", "format": "binary"}}
_IMAGES = {"image/png": _FILE, "image/jpeg": _FILE}
_NOT_CHANGED = (304,)


async def keyframe_of(request: Request, keyframe: int) -> Keyframe:
    """The keyframe, if it is of a map that the token may see. Raises Problem 404."""
    found = await read(request, lambda db: db.keyframe(keyframe))
    if not access_of(request).sees(found.map):
        raise not_found(f"keyframe {keyframe}")
    return found


@table.route("GET", "/v1/keyframes/{keyframe}", READ, schemas.Keyframe, errors=_NOT_CHANGED)
async def get_keyframe(request: Request, keyframe: KeyframeId) -> Response:
    """A keyframe: its camera and pose, which may be corrected later."""
    found = await keyframe_of(request, keyframe)
    return tagged(request, encoded(values.keyframe_dict(found)), "application/json", for_ever=False)


@table.route("GET", "/v1/keyframes/{keyframe}/image", READ, errors=_NOT_CHANGED, only=_IMAGES)
async def get_image(
    request: Request,
    keyframe: KeyframeId,
    width: Annotated[int | None, Query(ge=16, le=4096, description="a JPEG of at most so many pixels")] = None,
    box: Annotated[
        str | None, Query(max_length=200, description="only x1,y1,x2,y2 in pixels", examples=["60,40,259,199"])
    ] = None,
) -> Response:
    """The colour image, bytes as recorded; with `width` or `box` a smaller one. It never changes."""
    await keyframe_of(request, keyframe)
    stored = await read(request, lambda db: db.keyframe_files(keyframe))
    if width is not None or box is not None:
        smaller = await draw(request, lambda _: part_of(stored.rgb, keyframe, width, box))
        return tagged(request, smaller, "image/jpeg", for_ever=True)
    return tagged(request, stored.rgb, MEDIA.get(stored.rgb_format, "application/octet-stream"), for_ever=True)


@table.route(
    "GET",
    "/v1/keyframes/{keyframe}/depth",
    READ,
    errors=_NOT_CHANGED,
    only={"image/png": _FILE, "application/x-npy": _FILE},
)
async def get_depth(
    request: Request,
    keyframe: KeyframeId,
    metres: Annotated[bool, Query(description="float32 metres of each pixel of the image, as a file of NumPy")] = False,
) -> Response:
    """The depth image, bytes as recorded, with units per metre in Semdb-Depth-Scale. It never changes.

    With `metres` it is registered to the image, NaN where nothing was measured.
    """
    found = await keyframe_of(request, keyframe)
    if metres:
        depth = await read(request, lambda _: found.depth)
        if depth is None:
            raise not_found(f"depth of keyframe {keyframe}")
        file = io.BytesIO()
        np.save(file, depth, allow_pickle=False)
        return tagged(request, file.getvalue(), "application/x-npy", for_ever=True)
    stored = await read(request, lambda db: db.keyframe_files(keyframe))
    if stored.depth is None:
        raise not_found(f"depth of keyframe {keyframe}")
    headers = {"Semdb-Depth-Scale": repr(stored.depth_scale)}
    if stored.depth_registration:
        headers["Semdb-Depth-Registration"] = stored.depth_registration
    return tagged(
        *(request, stored.depth, MEDIA.get(stored.depth_format, "application/octet-stream")),
        for_ever=True,
        headers=headers,
    )


@table.route("GET", "/v1/keyframes/{keyframe}/objects", READ, schemas.Objects, errors=_NOT_CHANGED)
async def get_objects(
    request: Request,
    keyframe: KeyframeId,
    masks: Annotated[bool, Query(description="with the pixels of each object")] = False,
) -> Response:
    """The objects of a keyframe by ordinal, with places in the map, which follow its pose."""
    found = await keyframe_of(request, keyframe)
    things = await read(request, lambda _: found.objects)
    content = {"keyframe": keyframe, "objects": [values.object_dict(thing, mask=masks) for thing in things]}
    return tagged(request, encoded(content), "application/json", for_ever=False)


@table.route("GET", "/v1/keyframes/{keyframe}/mask", READ, errors=_NOT_CHANGED, only={"image/png": _FILE})
async def get_mask(request: Request, keyframe: KeyframeId) -> Response:
    """Whose each pixel is, as a PNG: 0 nobody's, else one more than the object's ordinal; the later one covers."""
    found = await keyframe_of(request, keyframe)

    def paint(_: Database) -> bytes:
        size = (found.camera.height, found.camera.width)
        labels = np.zeros(size, np.uint8 if len(found.objects) < 256 else np.uint16)
        for ordinal, thing in enumerate(found.objects):
            mask = thing.mask
            if mask.shape == size:
                labels[mask] = ordinal + 1
        return png_of(labels)

    return tagged(request, await draw(request, paint), "image/png", for_ever=True)


def part_of(file: bytes, keyframe: int, width: int | None, box: str | None) -> bytes:
    """A JPEG of an image, or of a box of it, of at most `width` pixels. Raises Problem 422, FrameError."""
    import cv2

    from semdb.recordings.images import decode_color

    image = decode_color(file, f"keyframe {keyframe}")
    if box is not None:
        image = image[_slices(box, image.shape[0], image.shape[1])]
    if width is not None and image.shape[1] > width:
        height = max(1, round(image.shape[0] * width / image.shape[1]))
        image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    return encode(np.ascontiguousarray(image), ".jpg")


def _slices(box: str, height: int, width: int) -> tuple[slice, slice]:
    try:
        x1, y1, x2, y2 = (min(max(float(part), -1e6), 1e6) for part in box.split(","))
        left, top, right, bottom = (round(value) for value in (x1, y1, x2, y2))
    except ValueError:
        raise Problem(422, "box is x1,y1,x2,y2 in pixels") from None
    left, top, right, bottom = max(0, left), max(0, top), min(width - 1, right), min(height - 1, bottom)
    if right < left or bottom < top:
        raise Problem(422, f"the box is outside of the image, which has {width}x{height} pixels")
    return slice(top, bottom + 1), slice(left, right + 1)


def png_of(labels: Any) -> bytes:
    """A grey image as a PNG file."""
    import cv2

    return bytes(cv2.imencode(".png", labels)[1])


@table.route("GET", "/v1/keyframes/{keyframe}/picture", READ, errors=_NOT_CHANGED, only={"image/png": _FILE})
async def get_picture(request: Request, keyframe: KeyframeId) -> Response:
    """The image with its objects drawn into it."""
    found = await keyframe_of(request, keyframe)
    drawn = await draw(request, lambda _: encode(found.picture(), ".png"))
    return tagged(request, drawn, "image/png", for_ever=False)


@table.route("GET", "/v1/keyframes/{keyframe}/keypoints", READ, schemas.KeypointColumns, errors=_NOT_CHANGED)
async def get_keypoints(request: Request, keyframe: KeyframeId) -> Response:
    """Local features with their 3D points, without descriptors, column by column."""
    found = await keyframe_of(request, keyframe)

    def look(_: Database) -> bytes:
        return encoded(values.keypoints_dict(found.keypoints, found.categories))

    return tagged(request, await read(request, look), "application/json", for_ever=False)
