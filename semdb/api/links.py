"""Links between keyframes, with names and with how far present poses are off."""

from __future__ import annotations

from semdb.database.links import list_links
from semdb.database.store import Store
from semdb.door.links import KeyframeLink
from semdb.geometry import invert_pose, pose_error


def links_of(store: Store, map_id: int | None, *, odometry: bool) -> list[KeyframeLink]:
    """Links of a map, or of all, by keyframe ids. Damaged rows are left out aloud."""
    links = list_links(store.engine, map_id, odometry=odometry, bad=store.left_out)
    maps = [map_id] if map_id is not None else [info.id for info in store.maps()]
    heads = {head.id: head for key in maps for head in store.keyframe_heads(key, bad=store.left_out)}
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
