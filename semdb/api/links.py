"""Links between keyframes, with names and with how far present poses are off."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from semdb.database.links import Key, list_links, page_of_links
from semdb.database.pose_records import Link
from semdb.database.records import KeyframeHead
from semdb.database.store import Store
from semdb.door.links import KeyframeLink
from semdb.errors import CodecError, NotFoundError
from semdb.geometry import invert_pose, pose_error


def links_of(
    store: Store, map_id: int | None, *, odometry: bool, after: Key | None = None, limit: int | None = None
) -> list[KeyframeLink]:
    """Links of a map, or of all, by keyframe ids; with `limit` so many of those after a key.

    Damaged rows are left out aloud.
    """
    if limit is None:
        links = list_links(store.engine, map_id, odometry=odometry, bad=store.left_out)
        maps = [map_id] if map_id is not None else [info.id for info in store.maps()]
        heads = {head.id: head for key in maps for head in store.keyframe_heads(key, bad=store.left_out)}
        return _named(links, heads)
    found: list[KeyframeLink] = []
    while len(found) < limit:  # some are left out
        links, last = page_of_links(
            store.engine, map_id, odometry=odometry, after=after, limit=limit, bad=store.left_out
        )
        found += _named(links, _heads(store, sorted({key for link in links for key in (link.first, link.second)})))
        if last is None:
            break
        after = last
    return found[:limit]


def _heads(store: Store, keys: Sequence[int]) -> dict[int, KeyframeHead]:
    """Those of these keyframes that are there and can be read."""
    if not keys:
        return {}
    try:
        return {head.id: head for head in store.keyframe_heads_of(keys)}
    except (NotFoundError, CodecError) as error:
        if len(keys) == 1:
            if isinstance(error, CodecError):
                store.left_out(keys[0], error)
            return {}
    half = len(keys) // 2
    return _heads(store, keys[:half]) | _heads(store, keys[half:])


def _named(links: Sequence[Link], heads: Mapping[int, KeyframeHead]) -> list[KeyframeLink]:
    found = []
    for link in links:
        one, two = heads.get(link.first), heads.get(link.second)
        if one is None or two is None:
            continue  # deleted a moment ago, or damaged
        metres, degrees = pose_error(invert_pose(one.world_from_camera) @ two.world_from_camera, link.first_from_second)
        found.append(
            KeyframeLink(
                map=one.map,
                keyframe=one.id,
                recording=one.recording,
                frame_index=one.frame_index,
                other_keyframe=two.id,
                other_recording=two.recording,
                other_frame_index=two.frame_index,
                kind=link.kind.value,
                state=link.state.value,
                first_from_second=link.first_from_second,
                information=link.information,
                inliers=link.inliers,
                off_m=metres,
                off_deg=degrees,
                reason=link.reason,
                provenance=link.provenance,
            )
        )
    return found
