"""What keyframes hold, asked for when it is first needed."""

from __future__ import annotations

from semdb.client.problems import document_of, error_of
from semdb.client.transport import Transport
from semdb.client.values import keypoints_of, object_of
from semdb.door.values import SeenObject
from semdb.types import Camera, Float32Array, ImageArray, Keypoints


class RemoteContent:
    """Reads from a service. Files come as they were recorded and are decoded here."""

    def __init__(self, transport: Transport) -> None:
        self._transport = transport

    def image(self, keyframe_id: int) -> ImageArray:
        """RGB ``[H, W, 3]``. Raises NotFoundError, FrameError, DatabaseError."""
        from semdb.recordings.images import decode_color

        found = self._transport.ask("GET", f"/v1/keyframes/{keyframe_id}/image")
        return decode_color(found.content, f"keyframe {keyframe_id}")

    def depth(self, keyframe_id: int, camera: Camera) -> Float32Array | None:
        """Metres ``[H, W]``, registered to the image of `camera`; None without."""
        from semdb.recordings.registration import decode_registered_depth

        found = self._transport.ask("GET", f"/v1/keyframes/{keyframe_id}/depth", expected=(404,))
        if found.status_code == 404:
            if str(document_of(found).get("detail", "")).startswith("there is no depth of keyframe"):
                return None
            raise error_of(found, self._transport.url)
        scale = float(found.headers["semdb-depth-scale"])
        registration = found.headers.get("semdb-depth-registration", "")
        return decode_registered_depth(found.content, f"depth of keyframe {keyframe_id}", scale, registration, camera)

    def objects(self, keyframe_id: int) -> tuple[SeenObject, ...]:
        """What was seen, by ordinal, with masks."""
        found = self._transport.json("GET", f"/v1/keyframes/{keyframe_id}/objects", params={"masks": True})
        return tuple(object_of(thing) for thing in found["objects"])

    def keypoints(self, keyframe_id: int) -> tuple[Keypoints, tuple[str, ...]]:
        """Keypoints without descriptors, and the classes of the objects."""
        return keypoints_of(self._transport.json("GET", f"/v1/keyframes/{keyframe_id}/keypoints"))
