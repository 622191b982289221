"""Rows of a map rewritten smaller, keyframe by keyframe: each is the old one or the new one, whenever it is stopped."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from sqlalchemy import Connection, Engine, Table, func, select, update

from semdb.byte_descriptors import as_float
from semdb.database import checked, retry, tables
from semdb.database.codecs import (
    COMPACT_MAGIC,
    decode_descriptors,
    encode_descriptors,
    encode_packed,
    image_format,
    keypoint_rows,
)
from semdb.database.engine import check_packet
from semdb.database.reading import Bad, keyframe_ids
from semdb.errors import CodecError

SMALLER = ("float16", "uint8")  # how descriptors of float can be made smaller
_RANK = {"float32": 0, "float16": 1, "int8": 2, "uint8": 2}  # of numpy's names; what is of bits is as small already
_STATEMENT = 4096  # bytes beside blobs
Keep = Callable[[bytes, bytes | None, str], tuple[bytes, bytes | None]]


@dataclass(frozen=True, slots=True)
class Compacted:
    """What was, or would be, rewritten: keyframes, and bytes of their descriptors, keypoints and images."""

    keyframes: int = 0
    rewritten: int = 0
    rows_before: int = 0
    rows_after: int = 0
    images_before: int = 0
    images_after: int = 0

    @property
    def saved(self) -> int:
        """Bytes."""
        return self.rows_before + self.images_before - self.rows_after - self.images_after


def compact_map(
    engine: Engine,
    map_id: int,
    dtype: str | None,
    keep: Keep | None,
    *,
    dry_run: bool = False,
    bad: Bad | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Compacted:
    """Rewrites keyframes whose descriptors are larger than `dtype` (one of `SMALLER`), and what `keep` makes of images.

    A transaction for each. What is as small already stays, so that a second run does what the first left. A damaged
    keyframe stays and is told to `bad`, or raises CodecError. `dry_run` writes nothing.
    """
    ids = keyframe_ids(engine, map_id)
    total = Compacted()
    for done, key in enumerate(ids, 1):
        try:
            work = partial(_compact, key=key, dtype=dtype, keep=keep, dry_run=dry_run)
            one = (retry.read if dry_run else retry.write)(engine, work)
        except CodecError as error:
            if bad is None:
                raise
            bad(key, error)
            one = Compacted()
        total = _sum(total, one)
        if progress is not None:
            progress(done, len(ids))
    return total


def _sum(one: Compacted, other: Compacted) -> Compacted:
    names = Compacted.__slots__
    return Compacted(*(getattr(one, name) + getattr(other, name) for name in names))


def _compact(connection: Connection, key: int, dtype: str | None, keep: Keep | None, dry_run: bool) -> Compacted:
    """One keyframe; nothing where it was deleted meanwhile."""
    changed: list[tuple[Table, dict[str, Any]]] = []
    rows_before, rows_after, changes = _rows(connection, key, dtype)
    changed += changes
    images_before, images_after, changes = _images(connection, key, keep)
    changed += changes
    if not rows_before and not images_before:
        return Compacted()
    for table, values in () if dry_run else changed:
        size = _STATEMENT + sum(len(value) for value in values.values() if isinstance(value, bytes))
        check_packet(connection, size, f"the {table.name} row of keyframe {key}")
        connection.execute(update(table).where(table.c.keyframe_id == key).values(**values))
    return Compacted(1, int(bool(changed)), rows_before, rows_after, images_before, images_after)


_Change = list[tuple[Table, dict[str, Any]]]


def _rows(connection: Connection, key: int, dtype: str | None) -> tuple[int, int, _Change]:
    """Bytes of descriptors and keypoints, what they would be, and the values that make it so."""
    k, d = tables.keypoints.c, tables.descriptors.c
    if dtype is None:
        sizes = select(func.length(k.data) + func.length(d.data))
        sizes = sizes.join(tables.descriptors, d.keyframe_id == k.keyframe_id)
        size = int(connection.execute(sizes.where(k.keyframe_id == key)).scalar() or 0)
        return size, size, []
    query = select(k.data, d.data.label("described")).join(tables.descriptors, d.keyframe_id == k.keyframe_id)
    row = connection.execute(query.where(k.keyframe_id == key)).one_or_none()
    if row is None:
        return 0, 0, []
    where = f"keyframe {key}"
    keypoints = checked.blob(row.data, f"keypoints.data of {where}")
    described = checked.blob(row.described, f"descriptors.data of {where}")
    values = decode_descriptors(described, f"descriptors.data of {where}")
    changes: _Change = []
    small = (
        described
        if _RANK[values.dtype.name] >= _RANK[dtype]
        else encode_descriptors(np.asarray(as_float(values), np.float32), dtype)
    )
    if len(small) < len(described):
        changes.append((tables.descriptors, {"data": small}))
    else:
        small = described
    packed = keypoints
    if keypoints[:4] != COMPACT_MAGIC and values.dtype != np.uint8:
        packed = encode_packed(keypoint_rows(keypoints, f"keypoints.data of {where}"), small=True)
        if packed[:4] == COMPACT_MAGIC and len(packed) < len(keypoints):
            changes.append((tables.keypoints, {"data": packed}))
        else:
            packed = keypoints
    return len(keypoints) + len(described), len(packed) + len(small), changes


def _images(connection: Connection, key: int, keep: Keep | None) -> tuple[int, int, _Change]:
    """Bytes of image files, what they would be, and the values that make it so."""
    c = tables.keyframe_images.c
    where = f"keyframe {key}"
    if keep is None:
        row = connection.execute(select(c.rgb_bytes, c.depth_bytes).where(c.keyframe_id == key)).one_or_none()
        size = 0 if row is None else sum(checked.integer(n, f"keyframe_images of {where}") for n in row)
        return size, size, []
    rgb, depth = (checked.up_to(column, checked.MOST_FILE) for column in (c.rgb, c.depth))
    row = connection.execute(select(rgb, depth).where(c.keyframe_id == key)).one_or_none()
    if row is None:
        return 0, 0, []
    files = checked.blob(row.rgb, f"keyframe_images.rgb of {where}")
    metres = None if row.depth is None else checked.blob(row.depth, f"keyframe_images.depth of {where}")
    small, small_depth = keep(files, metres, f"keyframe_images.rgb of {where}")
    before, after = len(files) + len(metres or b""), len(small) + len(small_depth or b"")
    if small == files and small_depth == metres:
        return before, before, []
    values: dict[str, Any] = {}
    if small != files:
        values |= {"rgb": small, "rgb_format": image_format(small), "rgb_bytes": len(small)}
    if metres is not None and small_depth is None:
        values |= {"depth": None, "depth_format": "", "depth_bytes": 0, "depth_scale": None, "depth_registration": ""}
    return before, after, [(tables.keyframe_images, values)]
