"""Values that options and arguments take, without opening anything that is slow: see `semdb.cli.completion`."""

from __future__ import annotations

import re
import sqlite3
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import unquote

Entries = Sequence[tuple[str, str]]
Given = Mapping[str, str]
Environment = Mapping[str, str]

MOST_NAMES = 200
_PATHS = re.compile(r"\b(PATH|FILE|FOLDER|DIR|IMAGE)\b")  # words of metavars
EXPORTS = ("tum", "colmap", "kapture", "ply", "mcap", "rrd", "landmarks", "g2o", "semdb")
METHODS = (
    *("semdb", "cnn", "paper", "chen", "sift-reference", "oracle", "colmap"),
    *("posenet", "posenet-4d", "cnn-lstm", "middle-keyframe", "mean-pose"),
)
FIXED: Mapping[str, Entries] = {
    "--features": (
        ("surf", "SURF, 64 dimensions"),
        ("surf:weak", "SURF, weak keypoints of plain images, too"),
        ("sift", "SIFT"),
        ("orb", "ORB, binary"),
    ),
    "--device": (("auto", "the best there is"), ("cpu", ""), ("cuda", ""), ("mps", "Metal")),
    "--classes": (("indoor", "31 classes of COCO"), ("all", "what the detector knows")),
    "--dynamic": (("person", ""), ("person,cat,dog", ""), ("none", "nothing moves")),
    "--coarse": (("sql", "class filter in the database"), ("index", "in a mirror in memory")),
    "--step": (
        ("poses", "poses that agree with their images"),
        ("classes", "classes taken for each other"),
        ("points", "points that several keyframes see"),
        ("errors", "how far recorded poses are off"),
        ("landmarks", "things that keyframes are sightings of"),
    ),
    "--redescribe": (("encoder", "vectors of keyframes, by the encoder and crop that are set"),),
    "--poses": (("recorded", ""), ("estimated", "from images and depth"), ("auto", "recorded where there are some")),
    "--method": tuple((name, "") for name in METHODS),
    "--protocol": (("paper", "keyframes and queries of one recording"), ("split", "of different ones")),
    "--truth": (("given", "poses of the recording"), ("refined", "by structure from motion"), ("both", "")),
    "--poses-are": (("world_from_camera", "usual"), ("camera_from_world", "inverted")),
    "--axes": (("opencv", "z forward"), ("opengl", "z back"), ("arkit", "z back"), ("ros", "x forward")),
    "--quaternion": (("xyzw", "as TUM"), ("wxyz", "")),
    "--times": (("reversed", "poses run backwards"),),
    "--optimizer": (("sgd", ""), ("adamw", "")),
    "--database-url": (("sqlite:///", "a file"), ("mysql+pymysql://", "a server")),
}


def of_option(option: Any, given: Given, environment: Environment) -> tuple[Entries, bool]:
    """Values of a click option with what they are, and whether names of files fit too.

    `given` are the options of the line so far, by their long name.
    """
    name = max(option.opts, key=len)
    if name in FIXED:
        return FIXED[name], False
    if name in _COMPUTED:
        return _COMPUTED[name](given, environment)
    return _of_type(option)


def of_argument(command: Any, argument: Any, given: Given, environment: Environment) -> tuple[Entries, bool]:
    """Values of an argument of a click command; see `of_option`."""
    key = f"{command.name} {argument.name}"
    if key in _ARGUMENTS:
        return _ARGUMENTS[key](given, environment)
    if argument.metavar == "MAP":
        return _maps(given, environment)
    return _of_type(argument)


def _of_type(parameter: Any) -> tuple[Entries, bool]:
    # click's own types until typer 0.28, typer's descriptions of them since
    kind = getattr(parameter, "type_descriptor", None) or getattr(parameter, "type", None)
    choices = getattr(kind, "choices", None)
    if choices is not None:
        return [(str(getattr(choice, "value", choice)), "") for choice in choices], False
    return (), bool(_PATHS.search(str(parameter.metavar or "")))


def _maps(given: Given, environment: Environment) -> tuple[Entries, bool]:
    return _names("SELECT name, 'a map' FROM maps ORDER BY name", given, environment), False


def _recordings(given: Given, environment: Environment) -> tuple[Entries, bool]:
    query = (
        "SELECT r.name, 'a recording in the map ' || GROUP_CONCAT(m.name, ', ') FROM recordings r "
        "JOIN maps m ON m.id = r.map_id GROUP BY r.name ORDER BY r.name"
    )
    return _names(query, given, environment), False


def _recordings_or_folders(given: Given, environment: Environment) -> tuple[Entries, bool]:
    return _recordings(given, environment)[0], True


def _names(query: str, given: Given, environment: Environment) -> Entries:
    """(name, what it is) from a SQLite file, as it is at the moment; none from a server, which may be slow."""
    url = given.get("--database-url") or environment.get("SEMDB_DATABASE_URL") or "sqlite:///semdb.sqlite3"
    path = Path(unquote(url.removeprefix("sqlite:///"))).expanduser()
    if not url.startswith("sqlite:///") or not path.is_file():
        return ()
    # a reader of a file that nobody has open leaves nothing beside it
    mode = "mode=ro" if path.with_name(f"{path.name}-wal").exists() else "immutable=1"
    try:
        connection = sqlite3.connect(f"{path.absolute().as_uri()}?{mode}", uri=True, timeout=0.2)
        try:
            return [(str(name), str(text)) for name, text in connection.execute(f"{query} LIMIT {MOST_NAMES}")]
        finally:
            connection.close()
    except sqlite3.Error:
        return ()


def _models_folder(environment: Environment) -> Path:
    return Path(environment.get("SEMDB_CACHE_DIR") or "~/.cache/semdb").expanduser() / "models"


def _onnx_files(environment: Environment) -> Entries:
    found: dict[str, str] = {}
    for folder, where in ((_models_folder(environment), "in the models folder"), (Path(), "here")):
        try:
            found |= {f"onnx:{path.name}": where for path in sorted(folder.glob("*.onnx"))[:MOST_NAMES]}
        except OSError:
            continue
    return [*found.items(), ("onnx:", "a file")]


def _detectors(_given: Given, environment: Environment) -> tuple[Entries, bool]:
    own = ("recorded", "masks that come with the recording")
    return [own, *_onnx_files(environment), *_torchvision("detector"), ("auto", "the map's own")], True


def _encoders(_given: Given, environment: Environment) -> tuple[Entries, bool]:
    own = ("gist", "needs no file")
    return [own, *_onnx_files(environment), *_torchvision("encoder"), ("auto", "the map's own")], True


def _torchvision(role: str) -> Entries:
    from semdb.perception.catalogue import PUBLISHED

    return [(model.spec, model.description) for model in PUBLISHED if model.role == role]


def _published(_given: Given, _environment: Environment) -> tuple[Entries, bool]:
    from semdb.perception.catalogue import PUBLISHED

    return [*((model.name, model.description) for model in PUBLISHED), ("all", "")], False


def _formats(_given: Given, _environment: Environment) -> tuple[Entries, bool]:
    return [(name, "") for name in EXPORTS], False


_COMPUTED: Mapping[str, Callable[[Given, Environment], tuple[Entries, bool]]] = {
    "--map": _maps,
    "--like": _recordings_or_folders,
    "--detector": _detectors,
    "--encoder": _encoders,
}
_ARGUMENTS: Mapping[str, Callable[[Given, Environment], tuple[Entries, bool]]] = {
    "recording name": _recordings,  # of semdb delete
    "map name": _maps,
    "pull names": _published,
    "evaluate-detector spec": _detectors,
    "export form": _formats,
}
