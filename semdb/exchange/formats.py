"""The formats that maps are exported in, by name."""

from __future__ import annotations

import os
import shutil
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import cast

from semdb.database.store import Store
from semdb.errors import UsageError
from semdb.exchange.source import Exporter, ExportOptions, MapSource, Progress


@dataclass(frozen=True, slots=True)
class Format:
    """`where` is ``module:function`` of its `Exporter`; `about` says for people what it writes."""

    where: str
    about: str


FORMATS = {
    "tum": Format("semdb.exchange.tum:write_tum", "trajectory of the keyframes, for evo and others (a file)"),
    "colmap": Format("semdb.exchange.colmap:write_colmap", "text model with images, points and tracks (a folder)"),
    "kapture": Format("semdb.exchange.kapture:write_kapture", "sensors, trajectories, images, depth (a folder)"),
    "ply": Format("semdb.exchange.ply:write_ply", "coloured cloud of the keyframes' depth (a file)"),
    "mcap": Format("semdb.exchange.mcap:write_mcap", "images, cameras and poses for Foxglove and ROS 2 (a file)"),
    "rrd": Format("semdb.exchange.rrd:write_rrd", "cameras, images and depth for rerun (a file)"),
    "landmarks": Format("semdb.exchange.landmarks:write_landmarks", "things and boxes: .csv, .json, .geojson (a file)"),
    "g2o": Format("semdb.exchange.g2o:write_g2o", "keyframes and the links between them as a pose graph (a file)"),
    "semdb": Format("semdb.exchange.whole:write_whole", "the whole map, for `semdb import` (a folder)"),
}


def export_map(
    store: Store,
    name: str,
    map_name: str,
    out: Path,
    options: ExportOptions | None = None,
    progress: Progress | None = None,
) -> str:
    """Writes a map in a format; returns a line about what was written.

    One that fails leaves at `out` what was there: nothing, or an empty folder. Raises UsageError for a format that is
    none, or where something is at `out` already; NotFoundError for the map; DatabaseError; CodecError for damaged rows.
    """
    if name not in FORMATS:
        raise UsageError(f"there is no format {name!r}; there are {', '.join(FORMATS)}")
    module, function = FORMATS[name].where.split(":")
    write = cast(Exporter, getattr(import_module(module), function))
    source = MapSource.of(store, map_name, progress)
    there = os.path.lexists(out)
    empty = out.is_dir() and not any(out.iterdir())
    try:
        return write(source, out, options or ExportOptions())
    except BaseException:
        if not there:
            _remove(out)
        elif empty:
            for made in out.iterdir():
                _remove(made)
        raise


def _remove(made: Path) -> None:
    """A part of a map looks like one."""
    if made.is_dir() and not made.is_symlink():
        shutil.rmtree(made, ignore_errors=True)
    else:
        made.unlink(missing_ok=True)
