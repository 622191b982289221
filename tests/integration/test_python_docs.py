"""The programs of docs/python.md are run as they stand, one after the other, in one folder."""

from __future__ import annotations

import inspect
import re
from pathlib import Path

import cv2
import pytest

import semdb
from semdb.api import Database
from tests.conftest import REPOSITORY
from tests.integration.test_docs import blocks, run, workplace  # noqa: F401 (a fixture)

PAGE = REPOSITORY / "docs" / "python.md"
PROGRAMS = blocks(PAGE, ("python",))
MODELS = {"SEMDB_DETECTOR": "onnx:mask_rcnn.onnx", "SEMDB_ENCODER": "onnx:places.onnx"}


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from semdb.recordings.synthetic import SyntheticOptions
    from tests.rooms import render

    folder = tmp_path_factory.mktemp("python") / "room"
    return render(folder, SyntheticOptions(frames=30, width=320, height=240, lap_frames=90))


def test_the_first_program_is_at_most_ten_lines() -> None:
    assert len([line for line in PROGRAMS[0].splitlines() if line]) <= 10


def test_programs_run_one_after_the_other(workplace: Path) -> None:  # noqa: F811
    printed = []
    for number, program in enumerate(PROGRAMS):
        own = program.replace("517.3, 516.5, 318.6, 255.3", camera(workplace))  # not that of a Kinect
        (workplace / f"{number}.py").write_text(own)
        done = run(f"python {number}.py", workplace, **MODELS)
        assert done.returncode == 0, f"{program}\n{done.stderr}"
        printed.append(done.stdout)
    assert printed[0].startswith("localized [")
    assert "<robot 3: localized" in printed[1]
    assert "10 {} ()" in printed[2]
    assert "ingesting live 10 10" in printed[2]
    assert "chair" in printed[3]
    for name in ("found.png", "keyframe.png"):
        assert cv2.imread(str(workplace / name)).shape[0] > 700


def camera(folder: Path) -> str:
    from semdb.recordings import open_recording

    found = open_recording(folder / "rgbd_dataset_freiburg1_desk").camera
    return f"{found.fx}, {found.fy}, {found.cx}, {found.cy}"


def test_every_method_and_argument_is_on_the_page() -> None:
    text = PAGE.read_text()
    methods = [name for name, _ in inspect.getmembers(Database, inspect.isfunction) if not name.startswith("_")]
    missing = [name for name in methods if not re.search(rf"`(db\.)?{name}\b|db\.{name}\(", text)]
    assert missing == []
    arguments = set(inspect.signature(Database.localize).parameters) - {"self", "image"}
    assert [name for name in arguments if f"{name}=" not in text] == []
    for name in semdb.__all__:
        assert name in text or name in {
            "InstanceMasks",
            "Keyframe",
            "Answer",
            "Rows",
            "SeenObject",
            "Verdict",
            "ReadOptions",
        }
