"""A stored keyframe as a query: what semdb knows of its image, from its rows alone. No network is asked."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from semdb.database.records import StoredKeyframe
from semdb.database.store import Store
from semdb.errors import FrameError
from semdb.recordings.images import decode_color_grey, has_size
from semdb.types import Description, Detection, ModelInfo

CHUNK = 16


def stored_queries(
    store: Store, keyframe_ids: Sequence[int], models: tuple[ModelInfo, ...]
) -> Iterator[tuple[StoredKeyframe, Description]]:
    """Keyframes and their descriptions in the order of `keyframe_ids`; damaged ones are left out aloud.

    `models` are those that made the rows. Of what the detector saw only objects are known, not what was too weak to be
    one. Raises NotFoundError for a keyframe that is not there.
    """
    for start in range(0, len(keyframe_ids), CHUNK):
        some = list(keyframe_ids[start : start + CHUNK])
        found = store.load_keyframes(some, bad=store.left_out)
        ids, vectors = store.vectors_there(np.array([one.id for one in found], np.int64), bad=store.left_out)
        by_id = dict(zip(ids.tolist(), vectors, strict=True))
        for keyframe in found:
            if keyframe.id in by_id:
                yield keyframe, _description(store, keyframe, by_id[keyframe.id], models)


def _description(
    store: Store,
    keyframe: StoredKeyframe,
    vector: np.ndarray[tuple[int], np.dtype[np.float32]],
    models: tuple[ModelInfo, ...],
) -> Description:
    nothing = np.zeros((0, 0), np.bool_)
    data = store.load_image(keyframe.id).rgb
    grey = None
    if has_size(data, (keyframe.camera.width, keyframe.camera.height)):
        try:
            grey = decode_color_grey(data, f"keyframe_images.rgb of keyframe {keyframe.id}")
        except FrameError:
            grey = None  # it is matched by its descriptors alone
    return Description(
        camera=keyframe.camera,
        detections=tuple(Detection(one.category, one.score, one.box, nothing) for one in keyframe.objects),
        geometry=tuple(one.geometry for one in keyframe.objects),
        keypoints=keyframe.keypoints,
        cnn_vector=vector,
        models=models,
        grey=grey,
    )
