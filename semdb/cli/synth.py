"""`semdb synth`: render a room as a recording."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def command(
    directory: Annotated[Path, typer.Argument(metavar="DIR", help="A folder that is new or empty.")],
    frames: Annotated[int, typer.Option(help="Number of frames.")] = 120,
    width: Annotated[int, typer.Option(help="Pixels.")] = 640,
    height: Annotated[int, typer.Option(help="Pixels.")] = 480,
    seed: Annotated[int, typer.Option(help="The walk, the noise and the change of lighting.")] = 0,
    room_seed: Annotated[int, typer.Option(help="Furniture, layout and textures.")] = 0,
    noise: Annotated[bool, typer.Option("--noise", help="Noise of colour and depth as of a real sensor.")] = False,
    blur: Annotated[
        float, typer.Option(metavar="0..1", help="Motion blur: share of the time that the shutter is open.")
    ] = 0.0,
    lighting: Annotated[float, typer.Option(metavar="0..1", help="How much the lighting is changed.")] = 0.0,
    second_visit: Annotated[
        bool, typer.Option("--second-visit", help="Another walk through the same room, some objects moved.")
    ] = False,
    lap_frames: Annotated[int, typer.Option(help="Frames in which the camera turns once around.")] = 120,
    coco: Annotated[
        bool, typer.Option("--coco", help="Instance segmentation data in COCO's format instead of a recording.")
    ] = False,
    rooms: Annotated[
        int, typer.Option(help="Rooms, from --room-seed on, each with --frames images, in folders of their own.")
    ] = 1,
    split: Annotated[str, typer.Option(help="With --coco: name of the split.")] = "train",
    missed: Annotated[
        float, typer.Option(metavar="0..1", help="Share of the objects of a frame that the masks lack.")
    ] = 0.0,
    confused: Annotated[
        float, typer.Option(metavar="0..1", help="Share of them that go by the name of a class like theirs.")
    ] = 0.0,
    person: Annotated[bool, typer.Option("--person", help="Somebody walks to and fro before the camera.")] = False,
    plain: Annotated[
        bool, typer.Option("--plain", help="Everything in one colour each, but for one picture: hardly any texture.")
    ] = False,
    bare: Annotated[
        bool, typer.Option("--bare", help="As --plain, without small things and in colours that differ little.")
    ] = False,
    focal: Annotated[float, typer.Option(help="Focal length over the width: smaller is a wider lens.")] = 0.82,
    eye_height: Annotated[float, typer.Option(help="Metres of the camera above the floor.")] = 1.4,
    backwards: Annotated[
        bool, typer.Option("--backwards", help="The walk of the same --seed the other way round.")
    ] = False,
) -> None:
    """Render a furnished room as a recording.

    Colour, exact depth, poses and object masks along a smooth walk, in the TUM layout.
    """
    from semdb.cli.output import print_lines
    from semdb.cli.progress import Progress
    from semdb.recordings.synthetic import SyntheticOptions, write_synthetic_recording
    from semdb.recordings.synthetic.coco import write_synthetic_coco
    from semdb.recordings.synthetic.writer import write_synthetic_building

    options = SyntheticOptions(
        frames=frames,
        width=width,
        height=height,
        seed=seed,
        room_seed=room_seed,
        noise=noise,
        blur=blur,
        lighting=lighting,
        second_visit=second_visit,
        lap_frames=lap_frames,
        person=person,
        plain=plain,
        bare=bare,
        focal=focal,
        eye_height=eye_height,
        backwards=backwards,
        missed=missed,
        confused=confused,
    )
    if coco:
        with Progress("rendering", unit="images") as progress:
            write_synthetic_coco(directory, options, rooms, split, progress.update)
        print_lines(f"wrote {rooms * frames} images of {rooms} rooms to {directory / split}")
        return
    if rooms > 1:
        with Progress("rendering") as progress:
            folders = write_synthetic_building(directory, options, rooms, progress.update)
        print_lines(f"wrote {rooms} recordings of {frames} frames to {folders[0]} and so on: one map for all of them")
        return
    with Progress("rendering") as progress:
        write_synthetic_recording(directory, options, progress.update)
    print_lines(f"wrote {frames} frames of {width}x{height} to {directory}")
