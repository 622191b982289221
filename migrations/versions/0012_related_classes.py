"""Relations know the class of the other landmark, and searches for things read indexes alone.

Revision ID: 0012
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0012"
down_revision = "0011"
branch_labels = None
depends_on = None

Id = sa.BigInteger().with_variant(sa.Integer(), "sqlite")
RELATED = "ix_landmark_relations_landmark_id_other_category_id_kind_score"
BY_CLASS = "ix_landmarks_category_id_state_map_id_probability_x_y_z"


def upgrade() -> None:
    op.add_column("landmark_relations", sa.Column("other_category_id", Id, nullable=True))
    op.execute(
        "UPDATE landmark_relations SET other_category_id = "
        "(SELECT l.category_id FROM landmarks l WHERE l.id = landmark_relations.other_landmark_id)"
    )
    columns = ["landmark_id", "other_category_id", "kind", "score"]
    op.create_index(RELATED, "landmark_relations", columns)
    op.create_index(BY_CLASS, "landmarks", ["category_id", "state", "map_id", "probability", "x", "y", "z"])


def downgrade() -> None:
    op.drop_index(BY_CLASS, "landmarks")
    op.drop_index(RELATED, "landmark_relations")
    op.drop_column("landmark_relations", "other_category_id")
