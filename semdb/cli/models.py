"""`semdb models`: which models made the rows, which can be named in settings, and where their files come from."""

from __future__ import annotations

import functools
import re
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from semdb.cli.options import JsonFlag, Overrides, open_database, settings_options
from semdb.cli.output import print_json, print_lines, print_table
from semdb.errors import ModelError, UsageError

if TYPE_CHECKING:
    from semdb.cli.progress import Progress
    from semdb.settings import Settings
    from semdb.types import ImageArray

command = typer.Typer(
    help="The networks and features that describe images.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
)

# role, spec, needs a file, what it is
SPECS = (
    ("detector", "recorded", False, "object masks that come with the recording"),
    ("detector", "onnx:FILE", True, "a Mask R-CNN with the outputs boxes, labels, scores, masks"),
    ("detector", "torchvision:NAME|PATH", True, "a Mask R-CNN in torch: a published one, or a checkpoint"),
    ("encoder", "gist", False, "training-free global descriptor"),
    ("encoder", "onnx:FILE", True, "a CNN from image [B,3,224,224] (RGB, 0..1) to embedding"),
    ("encoder", "torchvision:NAME|PATH", True, "a ResNet in torch: a published one, or a checkpoint"),
    ("features", "surf", False, "SURF, 64 dimensions"),
    ("features", "surf:weak", False, "the same, with weak keypoints of images that give few"),
    ("features", "sift", False, "SIFT of OpenCV"),
    ("features", "orb", False, "ORB of OpenCV, binary"),
    ("features", "onnx:FILE", True, "a network from image [1,3,H,W] to keypoints, scores, descriptors"),
    ("matcher", "onnx:FILE", True, "a network that matches learned features (SEMDB_MATCHER)"),
)


@command.callback()
def group() -> None:
    """The networks and features that describe images."""


@command.command("list")
@settings_options(models=True)
def list_models(overrides: Overrides, json: JsonFlag = False) -> None:
    """List the specs that settings can name, the model files at hand, and which models made the rows of each map."""
    settings = overrides.settings()
    chosen = {role: str(getattr(settings, role)) for role in ("detector", "encoder", "features")}
    used = used_models(settings)
    files = model_files(settings, used or [])
    if json:
        specs = [{"role": r, "spec": s, "needs_file": f, "description": d} for r, s, f, d in SPECS]
        print_json({"specs": specs, "settings": chosen, "files": files, "maps": used})
        return
    print_table(("role", "spec", "description"), [(role, spec, text) for role, spec, _, text in SPECS])
    print_lines("", "set: " + ", ".join(f"{role} {spec}" for role, spec in chosen.items()), "")
    print_table(
        ("file", "spec", "at hand", "sha256", "licence", "made the rows of"),
        [
            (f["file"], f["spec"], "yes" if f["sha256"] else "no", f["sha256"][:12], f["licence"], ", ".join(f["maps"]))
            for f in files
        ],
    )
    print_lines("", f"folder: {files_folder(settings)}; `semdb models pull NAME` fetches what is not at hand")
    if not used:
        print_lines("maps: " + ("no database yet" if used is None else "none yet"))
        return
    print_lines("")
    columns = ("map", "role", "name", "sha256", "config")
    print_table(columns, [(u["map"], u["role"], u["name"], u["sha256"][:12], u["config"]) for u in used])


@command.command("pull")
def pull_models(
    names: Annotated[list[str], typer.Argument(metavar="NAME...", help="Published models by name, or all.")],
    sha256: Annotated[
        str | None,
        typer.Option("--sha256", metavar="HEX", help="Hash that the file must have, where its publisher gives none."),
    ] = None,
) -> None:
    """Download the weights of published models into the models folder.

    A download that broke off goes on where it stopped. The hash of every file is checked. Nothing else in semdb uses
    the network.
    """
    from semdb.cli.options import load_settings
    from semdb.cli.progress import Progress as Bar
    from semdb.cli.progress import say
    from semdb.perception.catalogue import BY_NAME, PUBLISHED
    from semdb.perception.pull import pull

    unknown = [name for name in names if name != "all" and name not in BY_NAME]
    if unknown:
        raise UsageError(f"no published model {', '.join(unknown)}: known are {', '.join(BY_NAME)}, and all")
    wanted = list(PUBLISHED) if "all" in names else [BY_NAME[name] for name in dict.fromkeys(names)]
    if sha256 is not None:
        if not re.fullmatch(r"[0-9a-fA-F]{64}", sha256) or len(wanted) != 1:
            raise UsageError("--sha256 takes the 64 hexadecimal digits of the file of one model")
        if not sha256.lower().startswith(wanted[0].sha256):
            raise UsageError(f"--sha256: the publisher of {wanted[0].name} gives another hash, {wanted[0].sha256}...")
        wanted = [replace(wanted[0], sha256=sha256.lower())]
    folder = files_folder(load_settings())
    failed: list[ModelError] = []
    for model in wanted:
        try:
            with Bar(f"pulling {model.name}", unit="MB") as progress:
                done = pull(model, folder, functools.partial(_show_megabytes, progress))
        except ModelError as error:
            if len(wanted) == 1:
                raise
            failed.append(error)  # the others go on
            say(str(error))
            continue
        print_lines(
            f"{model.name}: {'pulled' if done.fetched else 'there already'}, {done.path}, sha256 {done.sha256[:16]}…"
            + (" (recorded: its publisher gives none)" if done.recorded else ", as it should be")
            + f"; licence {model.licence}; use it as {model.spec}"
        )
    if failed:
        raise typer.Exit(1)


@command.command("export")
def export_model(
    spec: Annotated[str, typer.Argument(metavar="SPEC", help="torchvision:NAME or torchvision:PATH.")],
    target: Annotated[Path, typer.Argument(metavar="FILE.onnx", help="The file to write.")],
    check: Annotated[
        list[Path] | None,
        typer.Option("--check", metavar="PATH", help="Compare both on these images, or on frames of a recording."),
    ] = None,
    images: Annotated[int, typer.Option(min=1, help="Frames of each recording to compare on.")] = 5,
) -> None:
    """Write a torch network as an ONNX file for CPUs and robots, and compare the two.

    Exit code 1 when they differ by more than rounding.
    """
    from semdb.cli.options import load_settings
    from semdb.cli.progress import Progress, say
    from semdb.perception.onnx_check import check_export
    from semdb.perception.onnx_export import export

    settings = load_settings()
    done = export(spec, target, settings)
    print_lines(f"{done.role} {spec} is {done.path}, sha256 {done.sha256[:16]}…; use it as onnx:{done.path}")
    if not check:
        say("not compared with the original: --check IMAGE or --check RECORDING does that")
        return
    pictures = _pictures(check, images)
    with Progress("comparing", unit="images") as progress:
        print_lines(check_export(done, spec, pictures, settings, progress.update))


def _pictures(paths: list[Path], count: int) -> list[ImageArray]:
    """The images among `paths`, and `count` frames evenly spread over each recording."""
    from semdb.recordings import open_recordings, read_query_image

    found = []
    for path in paths:
        if path.is_file():
            found.append(read_query_image(path))
            continue
        for recording in open_recordings(path):
            entries = recording.entries
            step = max(1, len(entries) // count)
            found += [recording.read(entry).image for entry in entries[::step][:count]]
    return found


def _show_megabytes(progress: Progress, done: int, total: int) -> None:
    progress.go_on(done >> 20, total >> 20)


def files_folder(settings: Settings) -> Path:
    """Where files of models are kept."""
    from semdb.perception.model_files import models_dir

    return models_dir(settings)


def model_files(settings: Settings, used: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Published models, at hand or not, and other files in the models folder, with the maps whose rows they made.

    ``sha256`` is empty for what is not at hand.
    """
    from semdb.perception.catalogue import PUBLISHED
    from semdb.perception.model_files import file_sha256, onnx_sha256

    folder = files_folder(settings)
    rows = [
        {"name": m.name, "role": m.role, "file": m.file, "spec": m.spec, "licence": m.licence, "url": m.url}
        for m in PUBLISHED
    ]
    known = {row["file"] for row in rows}
    if folder.is_dir():
        for path in sorted(folder.iterdir()):
            if path.name not in known and path.suffix in (".onnx", ".pth", ".tar"):
                spec = f"{'onnx' if path.suffix == '.onnx' else 'torchvision'}:{path.name}"
                row = {
                    "name": path.name,
                    "role": "",
                    "file": path.name,
                    "spec": spec,
                    "licence": "not known",
                    "url": "",
                }
                rows.append({**row, "licence": _licence_in(path)})
    for row in rows:
        path = folder / row["file"]
        hash_of = onnx_sha256 if path.suffix == ".onnx" else file_sha256
        row["sha256"] = hash_of(path) if path.is_file() else ""
    return [
        {**row, "maps": sorted({u["map"] for u in used if row["sha256"] and u["sha256"] == row["sha256"]})}
        for row in rows
    ]


def _licence_in(path: Path) -> str:
    """What an ONNX file says of its licence."""
    from semdb.errors import ModelError
    from semdb.perception.model_files import OnnxModel

    if path.suffix == ".onnx":
        try:
            metadata = OnnxModel(path, 1, ()).metadata
        except ModelError:
            return "cannot be read"
        for key in ("licence", "license"):
            if metadata.get(key):
                return metadata[key]
    return "not known"


def used_models(settings: Settings) -> list[dict[str, Any]] | None:
    """The models of each map, None where there is no database file yet. Raises `DatabaseError`."""
    from semdb.database.engine import parse_url, sqlite_path

    path = sqlite_path(parse_url(settings.database_url))
    if path is not None and not path.exists():
        return None
    with open_database(settings) as database:
        return [
            {"map": known.name, "role": m.role, "name": m.name, "sha256": m.sha256, "config": m.config}
            for known in database.maps()
            for m in database.models(known.name)
        ]
