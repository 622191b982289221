"""COCO-format data: images, classes and instance masks, a subset of the classes where wanted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from semdb.errors import FrameError, TrainingError
from semdb.files import MissingFileError, UnusableFileError, read_json
from semdb.recordings.images import decode_color, orientation_of, read_bytes
from semdb.storable_names import name_problem
from semdb.types import BoolArray, ImageArray

BACKGROUND = "background"
MOST_COCO_BYTES = 1 << 31


@dataclass(frozen=True, slots=True, eq=False)
class Instance:
    """One annotated object: `label` counts in the classes of the data (1 is the first), `box` is x, y, w, h pixels.

    `area` is that of the file, in pixels, None where it has none. A `crowd` is a region of many objects.
    """

    label: int
    box: tuple[float, float, float, float]
    segmentation: Any  # polygons [[x, y, ...], ...] or RLE {"size": [h, w], "counts": list or str}
    annotation_id: int
    area: float | None = None
    crowd: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """An image of the data and its objects. `others`, crowds and what is narrower than a pixel, are not learnt from."""

    image_id: int
    path: Path
    width: int
    height: int
    instances: tuple[Instance, ...]
    others: tuple[Instance, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class CocoData:
    """`classes` starts with the background; `category_ids` are those of the file, one per class after it."""

    file: Path
    classes: tuple[str, ...]
    category_ids: tuple[int, ...]
    pictures: tuple[Picture, ...]
    notes: tuple[str, ...] = ()  # for people


def load_coco(folder: Path, split: str, classes: Sequence[str] | None = None) -> CocoData:
    """``annotations/instances_SPLIT.json`` of `folder`, with images in ``SPLIT/`` (or ``images/``), as COCO has it.

    `classes` keeps these only, in this order; None takes all, in the order of the file. Raises TrainingError naming
    the file and entry for what is missing or contradicts itself.
    """
    file = folder / "annotations" / f"instances_{split}.json"
    try:
        content = read_json(file, MOST_COCO_BYTES)
    except MissingFileError:
        there = sorted(path.stem.removeprefix("instances_") for path in file.parent.glob("instances_*.json"))
        raise TrainingError(
            f"{file} is not there: COCO-format data have annotations/instances_SPLIT.json and their images in SPLIT/"
            + (f"; splits in it: {', '.join(there)}" if there else "")
        ) from None
    except UnusableFileError as error:
        where = "" if error.line is None else f"line {error.line}: "
        raise TrainingError(f"{file} cannot be read as JSON ({where}{error})") from error
    try:
        if not isinstance(content, dict) or not {"images", "annotations", "categories"} <= set(content):
            raise TypeError("it is no object with images, annotations and categories")
        return _parse(content, file, _image_folder(folder, split), classes)
    except KeyError as error:
        raise TrainingError(f"{file} is not in COCO's format: one of its entries has no {error}") from error
    except (TypeError, ValueError, AttributeError, OverflowError) as error:
        raise TrainingError(f"{file} is not in COCO's format: {error}") from error


def _image_folder(folder: Path, split: str) -> Path:
    for candidate in (folder / split, folder / "images"):
        if candidate.is_dir():
            return candidate
    raise TrainingError(f"{folder} has no folder {split}/ (nor images/) with the images of instances_{split}.json")


def _parse(content: dict[str, Any], file: Path, images: Path, wanted: Sequence[str] | None) -> CocoData:
    notes: list[str] = []
    by_name: dict[str, int] = {}
    for category in content["categories"]:
        by_name.setdefault(str(category["name"]), int(category["id"]))
    if len(by_name) < len(content["categories"]):
        notes.append(f"{file}: a class is listed more than once; all its ids are taken for the same class")
    names = list(wanted) if wanted is not None else sorted(by_name, key=lambda name: by_name[name])
    unknown = [name for name in names if name not in by_name]
    if unknown:
        raise TrainingError(f"{file} has no class {', '.join(unknown)}; it has {', '.join(sorted(by_name))}")
    for name in names:
        if (problem := name_problem(name)) is not None:
            raise TrainingError(f"{file}: the class name {name[:60]!r} {problem}: change it there, or leave it out")
    labels = {name: k for k, name in enumerate(names, start=1)}
    label_of = {int(category["id"]): labels.get(str(category["name"])) for category in content["categories"]}
    images_listed = _once(content["images"], file, notes)
    instances: dict[int, list[Instance]] = {int(image["id"]): [] for image in images_listed}
    strange = 0
    for row in content["annotations"]:
        label = label_of.get(int(row["category_id"]))
        if label is None:
            strange += int(row["category_id"]) not in label_of
            continue
        if int(row["image_id"]) not in instances:
            raise TrainingError(f"{file}: annotation {row['id']} is of image {row['image_id']}, which is not listed")
        x, y, w, h = (float(value) for value in row["bbox"])
        area, crowd = row.get("area"), bool(row.get("iscrowd"))
        one = Instance(label, (x, y, w, h), row["segmentation"], int(row["id"]), area and float(area), crowd)
        instances[int(row["image_id"])].append(one)
    pictures = tuple(
        Picture(
            int(image["id"]),
            images / image["file_name"],
            int(image["width"]),
            int(image["height"]),
            tuple(one for one in instances[int(image["id"])] if _is_learnt(one)),
            tuple(one for one in instances[int(image["id"])] if not _is_learnt(one)),
        )
        for image in images_listed
    )
    if not pictures:
        raise TrainingError(f"{file} lists no image")
    if strange:
        notes.append(f"{file}: {strange} annotation(s) of classes that are not listed are left out")
    ids = tuple(by_name[name] for name in names)
    return CocoData(file, (BACKGROUND, *names), ids, pictures, tuple(notes))


def _once(listed: Sequence[dict[str, Any]], file: Path, notes: list[str]) -> list[dict[str, Any]]:
    """The images by their id, each once, and a note on those that were listed again, by id or by file."""
    by_id: dict[int, dict[str, Any]] = {}
    for image in listed:
        by_id.setdefault(int(image["id"]), image)
    files: dict[str, int] = {}
    for image in by_id.values():
        files[image["file_name"]] = files.get(image["file_name"], 0) + 1
    again = len(listed) - len(by_id)
    if again:
        notes.append(f"{file}: {again} image(s) are listed twice; the first entry of each id is kept")
    double = [name for name, count in files.items() if count > 1]
    if double:
        notes.append(
            f"{file}: {len(double)} image file(s) are listed under several ids, as {double[0]}: what is annotated "
            "under one of them counts as missing under the others"
        )
    return list(by_id.values())


def _is_learnt(instance: Instance) -> bool:
    return not instance.crowd and min(instance.box[2:]) >= 1


def read_picture(picture: Picture) -> ImageArray:
    """The RGB image ``[H, W, 3]``; see `read_marked_picture`."""
    return read_marked_picture(picture)[0]


def read_marked_picture(picture: Picture) -> tuple[ImageArray, int]:
    """The RGB image ``[H, W, 3]`` as stored, and its orientation mark (1: none), which is not applied.

    Raises TrainingError when it cannot be read or has another size than listed.
    """
    try:
        data = read_bytes(picture.path)
        image = decode_color(data, str(picture.path))
    except FrameError as error:
        raise TrainingError(
            f"{picture.path} (image {picture.image_id}) is not there or is no image ({error})"
        ) from error
    mark = orientation_of(data)
    if image.shape[:2] != (picture.height, picture.width):
        found = f"{image.shape[1]}x{image.shape[0]}"
        turned = ""
        if mark > 1 and image.shape[:2] == (picture.width, picture.height):
            turned = (
                ": it has an orientation mark, which semdb does not apply; annotations must be of the pixels as stored"
            )
        raise TrainingError(f"{picture.path} is {found}, but its entry says {picture.width}x{picture.height}{turned}")
    return image, mark


def mask_of(instance: Instance, picture: Picture) -> BoolArray:
    """The mask ``[H, W]`` of an instance. Raises TrainingError when it fits no format of COCO or not the image."""
    segmentation = instance.segmentation
    shape = (picture.height, picture.width)
    try:
        if isinstance(segmentation, list):
            polygons = [np.asarray(p, dtype=np.float64).reshape(-1, 2) for p in segmentation]
            mask = np.zeros(shape, dtype=np.uint8)
            cv2.fillPoly(mask, [np.rint(p * 16).astype(np.int32) for p in polygons], 1, shift=4)
            return mask.astype(np.bool_)
        if tuple(segmentation["size"]) != shape:
            raise ValueError(f"its size is {segmentation['size']}")
        counts = segmentation["counts"]
        return decode_rle(_uncompressed(counts) if isinstance(counts, str) else counts, shape)
    except (KeyError, TypeError, ValueError, cv2.error) as error:
        raise TrainingError(
            f"{picture.path}: the mask of annotation {instance.annotation_id} is broken ({error})"
        ) from error


def decode_rle(counts: Sequence[int], shape: tuple[int, int]) -> BoolArray:
    """The mask ``[H, W]`` of run lengths, column by column, zeros first. Raises ValueError when they do not fill it."""
    runs: npt.NDArray[np.int64] = np.asarray(counts, dtype=np.int64)
    if runs.sum() != shape[0] * shape[1] or (runs < 0).any():
        raise ValueError(f"runs of {runs.sum()} pixels for {shape[0] * shape[1]}")
    flat = np.repeat(np.arange(len(runs)) % 2 == 1, runs)
    mask: BoolArray = np.ascontiguousarray(flat.reshape(shape, order="F"))
    return mask


def _uncompressed(text: str) -> list[int]:
    """The run lengths of COCO's compressed string: groups of five bits, from the third run on as differences."""
    runs: list[int] = []
    position = 0
    while position < len(text):
        value, shift, more = 0, 0, True
        while more:
            code = ord(text[position]) - 48
            value |= (code & 0x1F) << shift
            more = bool(code & 0x20)
            position, shift = position + 1, shift + 5
            if not more and code & 0x10:
                value |= -1 << shift
        runs.append(value + (runs[-2] if len(runs) > 2 else 0))
    return runs
