"""What landmarks may be instead of what they most likely are.

Revision ID: 0016
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0016"
down_revision = "0015"
branch_labels = None
depends_on = None

Id = sa.BigInteger().with_variant(sa.Integer(), "sqlite")
OPTIONS = {"mysql_engine": "InnoDB", "mysql_charset": "utf8mb4", "mysql_collate": "utf8mb4_bin"}


def upgrade() -> None:
    if "landmark_categories" in sa.inspect(op.get_bind()).get_table_names():
        return  # an upgrade that was cut off on a server goes on here
    op.create_table(
        "landmark_categories",
        _key("category_id", sa.ForeignKey("categories.id")),
        _key("map_id", sa.ForeignKey("maps.id", ondelete="CASCADE"), index=True),
        _key("landmark_id", sa.ForeignKey("landmarks.id", ondelete="CASCADE"), index=True),
        sa.Column("probability", sa.Double, nullable=False),
        **OPTIONS,
    )


def downgrade() -> None:
    op.drop_table("landmark_categories")


def _key(name: str, foreign: sa.ForeignKey, *, index: bool = False) -> sa.Column[int]:
    return sa.Column(name, Id, foreign, nullable=False, autoincrement=False, primary_key=True, index=index)
