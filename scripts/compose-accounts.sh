#!/usr/bin/env bash
# Run once by the image mysql, when its data directory is made: the schema, and three accounts with the least rights
# that do (docs/database.md). Passwords come from the environment and go to the client on its standard input.
# No `exit` and no `set -u`: the image may read this file into its own shell.
semdb_password() {
  case "$1" in
    "" | *[!A-Za-z0-9]*) echo "passwords of semdb's accounts are letters and digits" >&2 && return 1 ;;
  esac
}

# All tables and views but the tokens and jobs of the service; CREATE lets rights be given before there is a table.
semdb_readable() {
  for table in \
    alembic_version cameras categories class_confusions cnn_vectors completed_categories descriptors frame_views ingest_items \
    keyframe_categories keyframe_changes keyframe_images keyframe_qualities keyframes keypoints \
    landmark_categories landmark_merges landmark_parts landmark_relations landmark_sightings landmark_views landmark_visits landmarks \
    loop_closures map_completions map_gravity map_models maps models object_features objects planned_links planned_poses \
    pose_covariances pose_errors pose_operations pose_revisions pose_sources queries recording_findings \
    recordings refined_points refinements keyframe_objects category_counts recording_summary covisible_objects \
    keypoint_counts keyframe_links keyframe_quality landmark_list landmark_relations_named \
    landmark_visit_list recording_pose_errors; do
    echo "GRANT CREATE, SELECT, SHOW VIEW ON \`semdb\`.\`$table\` TO 'semdb_reader'@'%';"
    echo "REVOKE CREATE ON \`semdb\`.\`$table\` FROM 'semdb_reader'@'%';"
  done
}

if semdb_password "$SEMDB_OWNER_PASSWORD" && semdb_password "$SEMDB_WRITER_PASSWORD" &&
  semdb_password "$SEMDB_READER_PASSWORD"; then
  MYSQL_PWD=$MYSQL_ROOT_PASSWORD mysql --protocol=socket --user=root <<SQL
CREATE DATABASE IF NOT EXISTS semdb CHARACTER SET utf8mb4 COLLATE utf8mb4_bin;
CREATE USER 'semdb_owner'@'%' IDENTIFIED BY '$SEMDB_OWNER_PASSWORD';
GRANT SELECT, INSERT, UPDATE, DELETE, CREATE, ALTER, DROP, INDEX, REFERENCES, CREATE VIEW, SHOW VIEW ON semdb.* TO 'semdb_owner'@'%';
CREATE USER 'semdb_writer'@'%' IDENTIFIED BY '$SEMDB_WRITER_PASSWORD';
GRANT SELECT, INSERT, UPDATE, DELETE ON semdb.* TO 'semdb_writer'@'%';
CREATE USER 'semdb_reader'@'%' IDENTIFIED BY '$SEMDB_READER_PASSWORD';
$(semdb_readable)
SQL
else
  false
fi
