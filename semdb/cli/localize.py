"""`semdb localize`: images, folders of them and recordings become camera poses."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Self

import typer

from semdb.cli.options import (
    AcceptOption,
    CameraOption,
    JsonFlag,
    Overrides,
    Reading,
    accepted,
    open_database,
    reading_options,
    settings_options,
)
from semdb.cli.server import ServerOption, check_server, open_server

if TYPE_CHECKING:
    from semdb.api import Answer, Database
    from semdb.cli.localized import AnswerTable, Tally
    from semdb.client import RemoteDatabase
    from semdb.errors import FrameError
    from semdb.recordings import ReadOptions

IMAGE_ENDINGS = frozenset([".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp", ".ppm", ".pgm", ".jp2", ".avif"])


@settings_options(models=True)
@reading_options()
def command(
    sources: Annotated[
        list[Path], typer.Argument(metavar="IMAGE|FOLDER|RECORDING...", help="Images, folders of them, recordings.")
    ],
    overrides: Overrides,
    reading: Reading,
    map_name: Annotated[
        str | None, typer.Option("--map", metavar="M", help="Map to look in; default: all maps.")
    ] = None,
    depth: Annotated[
        list[Path] | None,
        typer.Option("--depth", metavar="FILE", help="Depth image registered to the image; once per image."),
    ] = None,
    query_depth: Annotated[
        bool, typer.Option("--query-depth", help="Use the depth of recordings too, not the colour alone.")
    ] = False,
    like: Annotated[
        str | None,
        typer.Option("--like", metavar="RECORDING", help="Recording (name or folder) whose camera took the images."),
    ] = None,
    camera: CameraOption = None,
    every: Annotated[
        int, typer.Option("--every", metavar="N", min=1, help="Every N-th image of folders and recordings.")
    ] = 1,
    coarse: Annotated[
        str, typer.Option("--coarse", metavar="sql|index", help="Coarse step in SQL, or from a mirror in memory.")
    ] = "sql",
    accept: AcceptOption = None,
    trajectory: Annotated[
        Path | None,
        typer.Option("--trajectory", metavar="FILE", help="Write the poses of a recording in TUM's format."),
    ] = None,
    server: ServerOption = None,
    plot: Annotated[Path | None, typer.Option("--plot", metavar="DIR", help="Write a picture per image.")] = None,
    json: JsonFlag = False,
) -> None:
    """Find the camera pose of images. A verdict of `failed` is an answer: exit code 0, no pose.

    An image that cannot be read is named on stderr and makes the exit code 1; the others are localized all the same.
    """
    from semdb.cli.localized import Tally, trajectory_file
    from semdb.cli.output import print_lines
    from semdb.errors import UsageError

    groups = grouped(sources)
    check_options(groups, depth or [], query_depth, reading, trajectory)
    if server is not None:
        check_server(server, overrides, {"--plot": plot is not None})
    if plot is not None:
        if plot.suffix.lower() in (".png", ".jpg", ".jpeg") and not plot.is_dir():
            raise UsageError(
                f"--plot {plot}: is the name of a picture, but pictures are written into a folder: name one"
            )
        plot.mkdir(parents=True, exist_ok=True)
    tally = Tally()
    asked = Asked(
        map_name, tuple(depth or ()), like, camera, reading, every, query_depth, coarse, accepted(accept),
        server is not None,
    )  # fmt: skip
    with open_server(server) if server is not None else open_database(overrides.settings()) as database:
        if trajectory is not None:
            check_one_world(database, map_name)
        with trajectory_file(trajectory) as poses, Output(plot, json) as output:
            for group in groups:
                for number, answer in enumerate(asked.answers(database, group, tally)):
                    output.add(answer, group, number)
                    if poses is not None:
                        poses.add(answer, every * number)
    if not json and tally.verdicts:
        print_lines(tally.line)
    if tally.unread:
        raise typer.Exit(1)


@dataclass(frozen=True, slots=True)
class Group:
    """Images that are asked in one go: those named one by one, those of a folder, or a recording, without `images`."""

    path: Path | None
    images: tuple[Path, ...] = ()

    @property
    def recording(self) -> Path | None:
        return None if self.images else self.path


def grouped(sources: Sequence[Path]) -> list[Group]:
    """What the arguments are, in their order. Raises RecordingError for a folder that is neither."""
    from semdb.recordings.layouts import find_layout, not_a_recording

    groups: list[Group] = []
    for path in sources:
        if path.exists() and find_layout(path) is not None:
            groups.append(Group(path))
        elif path.is_dir():
            images = tuple(sorted(child for child in path.iterdir() if child.suffix.lower() in IMAGE_ENDINGS))
            if not images:
                raise not_a_recording(path)
            groups.append(Group(path, images))
        elif groups and groups[-1].path is None:
            groups[-1] = Group(None, (*groups[-1].images, path))
        else:
            groups.append(Group(None, (path,)))
    return groups


def check_options(
    groups: Sequence[Group], depth: Sequence[Path], query_depth: bool, reading: ReadOptions, trajectory: Path | None
) -> None:
    """Raises UsageError for options that mean nothing to what is asked."""
    from semdb.errors import UsageError
    from semdb.recordings.options import option_of

    recordings = [group for group in groups if group.recording is not None]
    if depth and any(group.path is not None for group in groups):
        raise UsageError("--depth is for images that are named one by one; recordings bring theirs: --query-depth")
    for option, given in {"--query-depth": query_depth, **{option_of(name): True for name in reading.given()}}.items():
        if given and not recordings and option != "--depth-scale":
            raise UsageError(f"{option} is for recordings, and none was given")
    if trajectory is not None and len(groups) != 1:
        raise UsageError("--trajectory is of one recording, or of the images of one folder: name one")


def check_one_world(database: Database | RemoteDatabase, map_name: str | None) -> None:
    """A trajectory is in one frame. Raises UsageError where several maps would answer."""
    from semdb.errors import UsageError

    names = [info.name for info in database.maps() if info.keyframes]
    if map_name is None and len(names) > 1:
        raise UsageError(f"--trajectory needs one map to be in, and there are {', '.join(names)}: say which with --map")


@dataclass(frozen=True, slots=True)
class Asked:
    """How images are asked."""

    map: str | None
    depth: tuple[Path, ...]
    like: str | None
    camera: str | None
    reading: ReadOptions
    every: int
    query_depth: bool
    coarse: str
    accept: tuple[float, float] | None
    remote: bool = False

    def answers(self, database: Database | RemoteDatabase, group: Group, tally: Tally) -> Iterator[Answer]:
        """The answers one by one, with progress where nobody sees them; what cannot be read is said and counted."""
        from semdb.cli.localized import prints_to_people
        from semdb.cli.progress import Progress, say

        def unreadable(error: FrameError) -> None:
            tally.unread += 1
            say(str(error))

        total, answers = self._ask(database, group, unreadable)
        before = tally.asked
        with Progress("localizing", "images", terminal=False if prints_to_people() or total < 2 else None) as progress:
            for answer in answers:
                tally.verdicts[answer.verdict] += 1
                if not prints_to_people():
                    progress.update(tally.asked - before, total)
                yield answer

    def _ask(
        self, database: Database | RemoteDatabase, group: Group, unreadable: Callable[[FrameError], None]
    ) -> tuple[int, Iterator[Answer]]:
        """How many there are, and the answers. A service has its own coarse step; the answers are the same."""
        own: dict[str, Any] = {"masks": False} if self.remote else {"coarse": self.coarse}
        own["accept"] = self.accept
        if group.recording is not None:
            opened = database.open_recording(
                group.recording, map=self.map, camera=self.camera, reading=self.reading, like=self.like
            )
            answers = database.localize_recording(
                opened,
                map=self.map,
                every=self.every,
                query_depth=self.query_depth,
                unreadable=unreadable,
                **own,
            )
            return len(opened.entries[:: self.every]), answers
        images = group.images[:: self.every]
        answers = database.localize_each(
            images,
            map=self.map,
            depth=self.depth[:: self.every] or None,
            depth_scale=self.reading.depth_scale,
            camera=self.camera,
            like=self.like,
            unreadable=unreadable,
            **own,
        )
        return len(images), answers


class Output:
    """Prints answers, and writes their pictures. A context manager that ends the JSON."""

    def __init__(self, plot: Path | None, json: bool) -> None:
        from semdb.cli.output import JsonList

        self._plot, self._pictures = plot, set[Path]()
        self._json = JsonList() if json else None
        self._table: tuple[Group, AnswerTable] | None = None

    def add(self, answer: Answer, group: Group, number: int) -> None:
        """The answer for the image of that number of a group."""
        from semdb.cli.localized import print_answer

        if self._json is not None:
            self._json.add(answer.as_dict())
        elif group.path is None:
            print_answer(answer)
        else:
            self._row(answer, group, number)
        if self._plot is not None:
            from semdb.cli.progress import say
            from semdb.pictures.localization import picture_path

            say(f"wrote {answer.save(picture_path(self._plot, answer.image, self._pictures))}")

    def _row(self, answer: Answer, group: Group, number: int) -> None:
        from semdb.cli.localized import AnswerTable

        if self._table is None or self._table[0] is not group:
            width = max(len(image.name) for image in group.images) if group.images else 6
            self._table = group, AnswerTable(str(group.path), "image" if group.images else "frame", width)
        label = Path(answer.image).name if group.images else str(answer.frame_index)
        self._table[1].add(answer, label)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: Any) -> None:
        if self._json is not None:
            self._json.__exit__(*error)
