"""`semdb keypoints`: the packed keypoints of a keyframe, for people and spreadsheets."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated, Any

import typer

from semdb.cli.options import Overrides, open_database, settings_options

if TYPE_CHECKING:
    from semdb.api import Keyframe

COLUMNS = ("object", "category", "x", "y", "size", "angle", "response", "laplacian", "X", "Y", "Z")


@settings_options(models=False)
def command(
    overrides: Overrides,
    keyframe: Annotated[int, typer.Argument(help="Id of the keyframe, as `semdb sql` shows it.")],
    csv: Annotated[bool, typer.Option("--csv", help="CSV with full precision instead of a table.")] = False,
) -> None:
    """List the keypoints of a keyframe.

    Object, pixel, size, angle, and the 3D point in metres in the camera's frame. Background keypoints have no
    object; a keypoint without depth has no 3D point.
    """
    from semdb.cli.output import print_rows

    with open_database(overrides.settings()) as database:
        listed = rows(database.keyframe(keyframe))
    print_rows(COLUMNS, listed, "csv" if csv else "table")


def rows(keyframe: Keyframe) -> list[tuple[Any, ...]]:
    """One row per keypoint, in stored order; None where there is no object or no 3D point."""
    categories = dict(enumerate(keyframe.categories))
    features, points = keyframe.keypoints.features, keyframe.keypoints.points
    result = []
    for i, ordinal in enumerate(keyframe.keypoints.object_index.tolist()):
        x, y, z = (None if math.isnan(value) else value for value in points[i].tolist())
        result.append(
            (
                None if ordinal < 0 else ordinal,
                categories.get(ordinal),
                *features.xy[i].tolist(),
                float(features.size[i]),
                float(features.angle[i]),
                float(features.response[i]),
                int(features.laplacian[i]),
                x,
                y,
                z,
            )
        )
    return result
