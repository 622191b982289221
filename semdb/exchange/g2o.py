"""The pose graph of a map in g2o's text format: keyframes as vertices, accepted links as edges.

``VERTEX_SE3:QUAT id x y z qx qy qz qw`` and ``EDGE_SE3:QUAT a b x y z qx qy qz qw`` with the upper triangle of the
information, row by row, translation first. g2o's error is the translation and the vector part of the quaternion, which
is half of the rotation vector: the information of rotations is scaled to that.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from semdb.database.links import list_links
from semdb.database.pose_records import Link, LinkState
from semdb.exchange.source import ExportOptions, MapSource, new_file
from semdb.geometry import quat_wxyz_from_rotation
from semdb.shown import for_terminal
from semdb.types import FloatArray

HALF_ANGLES = np.array([1.0, 1.0, 1.0, 2.0, 2.0, 2.0])  # radians of a rotation vector in one of a quaternion's vector


def write_g2o(source: MapSource, out: Path, options: ExportOptions) -> str:
    """Vertices are numbered by keyframe id; the first one is fixed. What is contradicted or failed stays behind."""
    links = list_links(source.store.engine, source.map_id, bad=source.store.left_out)
    accepted = [link for link in links if link.state is LinkState.ACCEPTED]
    known = {head.id for head in source.heads}
    edges = [link for link in accepted if link.first in known and link.second in known]
    with new_file(out).open("w", encoding="utf-8") as file:
        file.write(f"# map {for_terminal(source.name)!r}: world_from_camera of keyframes, metres; ids are semdb's\n")
        for done, head in enumerate(source.heads, 1):
            file.write(f"VERTEX_SE3:QUAT {head.id} {_pose(head.world_from_camera)}\n")
            source.tell("exporting", done)
        file.write(f"FIX {source.heads[0].id}\n")
        for link in edges:
            file.write(f"EDGE_SE3:QUAT {link.first} {link.second} {_pose(link.first_from_second)} {_upper(link)}\n")
    left = len(links) - len(edges)
    loose = len(known - {key for link in edges for key in (link.first, link.second)})
    return (
        f"{len(source.heads)} vertices, {len(edges)} edges"
        + (f"; {left} that do not count left out" if left else "")
        + (f"; {loose} vertices without an edge" if loose else "")
    )


def _pose(pose: FloatArray) -> str:
    w, x, y, z = quat_wxyz_from_rotation(pose[:3, :3])
    return " ".join(repr(float(number)) for number in (*pose[:3, 3], x, y, z, w))


def _upper(link: Link) -> str:
    scaled = link.information * HALF_ANGLES[:, None] * HALF_ANGLES
    return " ".join(repr(float(number)) for number in scaled[np.triu_indices(6)])
