"""`semdb loops`: which keyframes were found to show the same place, and whether that counts."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Annotated, Any

import typer

from semdb.cli.options import JsonFlag, Overrides, open_database, settings_options

if TYPE_CHECKING:
    from semdb.door.links import KeyframeLink

COLUMNS = ("map", "keyframe", "other", "kind", "state", "inliers", "apart m", "off m", "off deg", "why")


@settings_options(models=False)
def command(
    overrides: Overrides,
    map_name: Annotated[str | None, typer.Option("--map", metavar="M", help="Only this map; default: all.")] = None,
    everything: Annotated[
        bool, typer.Option("--all", help="Also links between keyframes that follow each other.")
    ] = False,
    json: JsonFlag = False,
) -> None:
    """List loop closures: pairs of keyframes whose images say how they lie to each other, and what became of each.

    "off" is by how much the poses that the keyframes have now differ from that.
    """
    from semdb.cli.output import print_json, print_lines, print_rows
    from semdb.cli.progress import say

    with open_database(overrides.settings()) as database:
        links = database.loops(map_name, odometry=everything)
    if json:
        print_json([as_json(link) for link in links])
        return
    if not links:
        say("no loop closure is stored: they come with estimated poses, semdb align and semdb refine --step poses")
        return
    print_rows(COLUMNS, [row(link) for link in links], "table")
    states = Counter(link.state for link in links)
    print_lines("", ", ".join(f"{count} {state}" for state, count in sorted(states.items())))


def row(link: KeyframeLink) -> tuple[Any, ...]:
    """One line of the table."""
    apart = float((link.first_from_second[:3, 3] ** 2).sum()) ** 0.5
    return (
        link.map,
        f"{link.recording}/{link.frame_index}",
        f"{link.other_recording}/{link.other_frame_index}",
        link.kind,
        link.state,
        link.inliers,
        round(apart, 3),
        round(link.off_m, 4),
        round(link.off_deg, 3),
        link.reason,
    )


def as_json(link: KeyframeLink) -> dict[str, Any]:
    """One item of `--json`. The pose is of the other keyframe in the frame of the first."""
    from semdb.geometry import quat_wxyz_from_rotation

    pose = link.first_from_second
    return {
        "map": link.map,
        "keyframe": link.keyframe,
        "recording": link.recording,
        "frame_index": link.frame_index,
        "other_keyframe": link.other_keyframe,
        "other_recording": link.other_recording,
        "other_frame_index": link.other_frame_index,
        "kind": link.kind,
        "state": link.state,
        "inliers": link.inliers,
        "pose": {"position": pose[:3, 3].tolist(), "quat_wxyz": quat_wxyz_from_rotation(pose[:3, :3]).tolist()},
        "information": link.information.tolist(),
        "off_m": link.off_m,
        "off_deg": link.off_deg,
        "reason": link.reason,
        "provenance": link.provenance,
    }
