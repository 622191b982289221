"""How strongly a keyframe shows a class, weak detections too, in the upper and the lower half of its image.

Rows that are there get what their stored objects give; weak detections were not kept.

Revision ID: 0005
"""

from __future__ import annotations

import math

import sqlalchemy as sa
from alembic import op

revision = "0005"
down_revision = "0004"
branch_labels = None
depends_on = None

TABLE = "keyframe_categories"
COLUMNS = ("upper_strength", "lower_strength", "keyframe_strength")
OLD_INDEX = "ix_keyframe_categories_map_id_category_id_keyframe_id_count"
NEW_INDEX = "ix_keyframe_categories_filter"
KEYS = ("map_id", "category_id", "keyframe_id", "count")
UNITS, MOST = 16, 255


def upgrade() -> None:
    there = {column["name"] for column in sa.inspect(op.get_bind()).get_columns(TABLE)}
    for name in COLUMNS:
        if name not in there:  # an upgrade that was cut off on a server goes on here
            op.add_column(TABLE, sa.Column(name, sa.Integer, nullable=False, server_default="0"))
    _fill()
    indexes = {index["name"] for index in sa.inspect(op.get_bind()).get_indexes(TABLE)}
    if NEW_INDEX not in indexes:
        op.create_index(NEW_INDEX, TABLE, [*KEYS, *COLUMNS])
    if OLD_INDEX in indexes:
        op.drop_index(OLD_INDEX, TABLE)


def _fill() -> None:
    connection = op.get_bind()
    select = sa.text(
        "SELECT o.keyframe_id, o.category_id, o.score, (o.y1 + o.y2 + 1) / (2.0 * c.height) AS middle FROM objects o "
        "JOIN keyframes k ON k.id = o.keyframe_id JOIN cameras c ON c.id = k.camera_id "
        "WHERE o.keyframe_id > :after AND o.keyframe_id <= :upto ORDER BY o.keyframe_id"
    )
    update = sa.text(
        f"UPDATE {TABLE} SET upper_strength = :upper, lower_strength = :lower, keyframe_strength = :held "
        "WHERE keyframe_id = :keyframe AND category_id = :category"
    )
    last = connection.execute(sa.text("SELECT COALESCE(MAX(id), 0) FROM keyframes")).scalar_one()
    for after in range(0, int(last), 1000):
        found: dict[int, dict[int, list[tuple[float, float]]]] = {}
        for row in connection.execute(select, {"after": after, "upto": after + 1000}):
            found.setdefault(row.keyframe_id, {}).setdefault(row.category_id, []).append((row.score, float(row.middle)))
        rows = [values for keyframe, shown in found.items() for values in _strengths(keyframe, shown)]
        if rows:
            connection.execute(update, rows)


def _strengths(keyframe: int, shown: dict[int, list[tuple[float, float]]]) -> list[dict[str, int]]:
    rows = []
    for category, found in shown.items():
        above = [min(1.0, max(0.0, 0.5 + 2 * (0.5 - middle))) for _, middle in found]
        upper = math.fsum(score * share for (score, _), share in zip(found, above, strict=True))
        lower = math.fsum(score * (1 - share) for (score, _), share in zip(found, above, strict=True))
        rows.append(
            {
                "keyframe": keyframe,
                "category": category,
                "upper": min(MOST, round(UNITS * upper)),
                "lower": min(MOST, round(UNITS * lower)),
            }
        )
    held = sum(row["upper"] + row["lower"] for row in rows)
    return [{**row, "held": held} for row in rows]


def downgrade() -> None:
    op.create_index(OLD_INDEX, TABLE, list(KEYS))
    op.drop_index(NEW_INDEX, TABLE)
    for name in reversed(COLUMNS):
        op.drop_column(TABLE, name)
