"""`semdb loops` and `semdb export g2o`, read back by its own reader and by a public one."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from graphslam.graph import Graph
from typer.testing import CliRunner

from semdb.cli.main import app
from semdb.database.links import list_links
from semdb.database.store import Store
from semdb.errors import UsageError
from semdb.exchange.formats import export_map
from semdb.geometry import pose_from, rotation_from_quat_wxyz
from semdb.types import FloatArray
from tests.database_samples import fill
from tests.pose_samples import fill_estimated


def run(url: str, *arguments: str) -> tuple[int, str, str]:
    done = CliRunner().invoke(app, [*arguments, "--database-url", url])
    return done.exit_code, done.stdout, done.stderr


def test_loops_are_listed(database_url: str, store: Store) -> None:
    code, out, err = run(database_url, "loops")
    assert (code, out) == (0, "")
    assert "no loop closure is stored" in err
    _, _, ids = fill_estimated(store)
    fill(store)
    code, out, _ = run(database_url, "loops")
    assert code == 0
    lines = out.splitlines()
    assert re.search(r"estimated +own/0 +own/20 +loop +accepted +40 ", lines[2])
    assert re.search(r"own/3 +own/20 +loop +contradicted +40 .* contradicts 41 of 42$", lines[3])
    assert lines[-1] == "1 accepted, 1 contradicted"
    code, out, _ = run(database_url, "loops", "--map", "estimated", "--all", "--json")
    found = json.loads(out)
    assert [(item["keyframe"], item["other_keyframe"], item["kind"]) for item in found] == [
        (ids[0], ids[1], "odometry"),
        (ids[0], ids[4], "loop"),
        (ids[1], ids[2], "odometry"),
        (ids[1], ids[4], "loop"),
        (ids[2], ids[3], "odometry"),
        (ids[3], ids[4], "odometry"),
    ]
    assert np.shape(found[1]["information"]) == (6, 6)
    assert found[1]["off_m"] > 0.01  # poses are made up, and so are links
    assert json.loads(run(database_url, "loops", "--map", "room", "--json")[1]) == []
    code, _, err = run(database_url, "loops", "--map", "hall")
    assert code == 1
    assert "there is no map 'hall'" in err


def read_g2o(path: Path) -> tuple[dict[int, FloatArray], list[tuple[int, int, FloatArray, FloatArray]], list[int]]:
    """Vertices, edges with information of (translation, vector of the quaternion), and what is fixed."""
    vertices, edges, fixed = {}, [], []
    for line in path.read_text().splitlines():
        word, *numbers = line.split()
        if word == "VERTEX_SE3:QUAT":
            vertices[int(numbers[0])] = _pose(numbers[1:])
        elif word == "EDGE_SE3:QUAT":
            matrix = np.zeros((6, 6))
            matrix[np.triu_indices(6)] = [float(n) for n in numbers[9:]]
            matrix += np.triu(matrix, 1).T
            edges.append((int(numbers[0]), int(numbers[1]), _pose(numbers[2:9]), matrix))
        elif word == "FIX":
            fixed.append(int(numbers[0]))
        else:
            assert word == "#"
    return vertices, edges, fixed


def _pose(words: list[str]) -> FloatArray:
    x, y, z, qx, qy, qz, qw = (float(word) for word in words)
    return pose_from(rotation_from_quat_wxyz([qw, qx, qy, qz]), [x, y, z])


def test_a_pose_graph_is_read_back(store: Store, tmp_path: Path) -> None:
    map_id, _, ids = fill_estimated(store)
    out = tmp_path / "graph.g2o"
    assert export_map(store, "g2o", "estimated", out) == "5 vertices, 5 edges; 1 that do not count left out"
    vertices, edges, fixed = read_g2o(out)
    assert fixed == ids[:1]
    stored = dict(zip(*store.poses(map_id), strict=True))
    for key, pose in vertices.items():
        np.testing.assert_allclose(pose, stored[key], atol=1e-15)
    links = [link for link in list_links(store.engine) if link.state == "accepted"]
    assert [(first, second) for first, second, _, _ in edges] == [(link.first, link.second) for link in links]
    for (_, _, pose, matrix), link in zip(edges, links, strict=True):
        np.testing.assert_allclose(pose, link.first_from_second, atol=1e-15)
        np.testing.assert_allclose(matrix[:3, :3], link.information[:3, :3])
        np.testing.assert_allclose(matrix[:3, 3:], 2 * link.information[:3, 3:])
        # a turn of a hundredth of a radian costs the same either way
        turn = np.array([0.0, 0, 0, 0.01, 0, 0])
        half = np.array([0.0, 0, 0, np.sin(0.005), 0, 0])
        assert half @ matrix @ half == pytest.approx(turn @ link.information @ turn, rel=1e-4)
    public = Graph.from_g2o(str(out))
    assert [(one.vertex_ids, one.vertices[0].id) for one in public._edges] == [([a, b], a) for a, b, _, _ in edges]
    for vertex in public._vertices:
        *position, x, y, z, w = vertex.pose.to_array()
        read = pose_from(rotation_from_quat_wxyz([w, x, y, z]), position)
        np.testing.assert_allclose(read, stored[vertex.id], atol=1e-12)
    for edge, (_, _, _, matrix) in zip(public._edges, edges, strict=True):
        np.testing.assert_allclose(edge.information, matrix, rtol=1e-12)
    with pytest.raises(UsageError, match="is there already"):
        export_map(store, "g2o", "estimated", out)
    fill(store)
    assert export_map(store, "g2o", "room", tmp_path / "room.g2o") == (
        "5 vertices, 0 edges; 5 vertices without an edge"
    )
