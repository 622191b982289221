"""The commands and programs of README.md and docs/ are run as they stand, on a rendered room under their names."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from semdb.recordings.synthetic import SyntheticOptions
from tests.conftest import REPOSITORY
from tests.rooms import environment, render
from tests.unit.onnx_files import write_constant_model, write_mean_embedding_model

NAMES = (
    "rgbd_dataset_freiburg1_desk",
    "rgbd_dataset_freiburg1_rpy",
    "RECORDING",
    "redkitchen",
    "freiburg1_rpy",
    "recordings/room",
)
# Words of blocks that need what a test has not: another machine, a Docker engine, the make targets themselves.
NOT_RUN = (
    "docker compose",
    "make ",
    "pip install",
    "semdb_owner",
    "root:PASSWORD",
    "celery ",
    "sqlite3 FILE",
    "models pull",
    "torchvision:",
)
# an evaluation has fewer keyframes and asks about fewer images than it would: what they are asked with is the same
EVALUATION = re.compile(r"^semdb evaluate (?!.*--max-queries)", re.MULTILINE)
KEYFRAMES = re.compile(r"(?<=--keyframes )\d+(,\d+)*")
SERVER_URL = re.compile(r"mysql\+pymysql://semdb:PASSWORD@HOST(?::3306)?/semdb")


def blocks(path: Path, languages: tuple[str, ...]) -> list[str]:
    """Code blocks of a Markdown file in one of `languages`, prompts and what commands printed left out."""
    found = re.findall(r"^```(\w*)\n(.*?)^```", path.read_text(), re.MULTILINE | re.DOTALL)
    chosen = []
    for language, text in found:
        if language not in languages:
            continue
        prompted = [line[2:] for line in text.splitlines() if line.startswith("$ ")]
        chosen.append("\n".join(prompted) if prompted else text)
    return chosen


def shell_blocks(path: Path) -> list[str]:
    return [
        block
        for block in blocks(path, ("", "bash", "console", "sh"))
        if re.search(r"^semdb ", block, re.MULTILINE) and not any(word in block for word in NOT_RUN)
    ]


DOCUMENTS = [
    *(REPOSITORY / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")),
    *sorted((REPOSITORY / "docs").glob("*.md")),
]
# the page of the service needs one that runs: test_service_docs
WITH_COMMANDS = [path for path in DOCUMENTS if shell_blocks(path) and path.name != "service.md"]


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return render(
        tmp_path_factory.mktemp("documented") / "room",
        SyntheticOptions(frames=44, width=320, height=240, lap_frames=120),
    )


@pytest.fixture
def workplace(rendered: Path, tmp_path: Path) -> Path:
    """A folder in which the names of the documents exist."""
    for name in NAMES:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copytree(rendered, tmp_path / name)
    (tmp_path / ".venv").symlink_to(sys.prefix)
    shutil.copy(sorted((rendered / "rgb").iterdir())[7], tmp_path / "photo.png")
    masks = np.zeros((1, 1, 240, 320), np.float32)
    masks[:, :, 40:200, 60:260] = 1
    for name in ("mask_rcnn.onnx", "mask_rcnn_2go.onnx"):
        write_constant_model(
            tmp_path / name,
            {
                "boxes": np.array([[60, 40, 259, 199]], np.float32),
                "labels": np.array([62], np.int64),
                "scores": np.array([0.9], np.float32),
                "masks": masks,
            },
        )
    for name in ("places.onnx", "squeezenet_places365.onnx"):
        write_mean_embedding_model(tmp_path / name)
    return tmp_path


def run(script: str, folder: Path, **variables: str) -> subprocess.CompletedProcess[str]:
    found = environment("sqlite:///semdb.sqlite3", **variables)
    found["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{found['PATH']}"
    return subprocess.run(
        ["bash", "-euo", "pipefail", "-c", script],
        cwd=folder,
        env=found,
        capture_output=True,
        text=True,
        timeout=400,
        check=False,
    )


def smaller(block: str) -> str:
    """The same commands with a fifth of the keyframes, and of queries so many as show that it works."""
    fewer = KEYFRAMES.sub(lambda found: ",".join(str(max(4, int(n) // 5)) for n in found[0].split(",")), block)
    return EVALUATION.sub("semdb evaluate --max-queries 4 ", fewer)


@pytest.mark.parametrize("path", WITH_COMMANDS, ids=lambda path: path.name)
def test_commands_of_the_documents_work(path: Path, workplace: Path, any_server_url: str) -> None:
    for block in shell_blocks(path):
        script = smaller(SERVER_URL.sub(any_server_url, block))
        done = run(script, workplace, SEMDB_READER_URL=any_server_url, MODELS=str(workplace))
        assert done.returncode == 0, f"{block}\n{done.stdout}\n{done.stderr}"


def test_the_program_of_the_readme_works(workplace: Path) -> None:
    [program] = blocks(REPOSITORY / "README.md", ("python",))
    models = {"SEMDB_DETECTOR": "onnx:mask_rcnn.onnx", "SEMDB_ENCODER": "onnx:places.onnx"}
    done = run("semdb ingest recordings/room --keyframes 15", workplace, **models)
    assert done.returncode == 0, done.stderr
    (workplace / "program.py").write_text(program)
    done = run("python program.py", workplace, **models)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("localized [[")


def test_what_the_page_on_sensors_writes_is_a_recording(tmp_path: Path) -> None:
    [program] = blocks(REPOSITORY / "docs" / "sensors.md", ("python",))
    done = run(f"python - <<'EOF'\n{program}\nEOF\nsemdb recording my_room --json", tmp_path)
    assert done.returncode == 0, done.stderr
    [seen] = json.loads(done.stdout)
    assert (seen["format"], seen["frames"], seen["triples"], seen["depth_scale"]) == ("tum", 5, 5, 1000)
    assert seen["trajectory_length_m"] == pytest.approx(0.04)
    assert not [line for line in seen["notes"] if "assumed" in line]


def test_the_documents_name_commands_to_run() -> None:
    names = {path.name for path in WITH_COMMANDS}
    assert {"README.md", "commands.md", "evaluation.md", "deployment.md"} <= names
    assert sum(len(shell_blocks(path)) for path in WITH_COMMANDS) >= 8


def test_links_between_documents_lead_somewhere() -> None:
    for path in DOCUMENTS:
        for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", path.read_text()):
            if "://" not in target:
                assert (path.parent / target).exists(), f"{path.name}: {target}"
