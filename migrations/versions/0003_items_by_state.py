"""An index for what a state of the plan holds: failed keyframes, and the counts of `semdb status`.

Revision ID: 0003
"""

from __future__ import annotations

from alembic import op

revision = "0003"
down_revision = "0002"
branch_labels = None
depends_on = None

NAME = "ix_ingest_items_state_recording_id_frame_index"


def upgrade() -> None:
    op.create_index(NAME, "ingest_items", ["state", "recording_id", "frame_index"])


def downgrade() -> None:
    op.drop_index(NAME, table_name="ingest_items")
