"""Pictures as torchvision's detectors learn from them, in an order that only seed and epoch decide."""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from semdb.perception.detectors.torchvision import image_tensor
from semdb.training.coco import CocoData, Picture, mask_of, read_picture

Sample = tuple[Any, dict[str, Any]]  # image [3, H, W], target
_AHEAD = 2  # batches
_MOST_READERS = 8


def batches(data: CocoData, batch: int, seed: int, epoch: int, start: int, torch: Any) -> Iterator[list[Sample]]:
    """The batches of an epoch from number `start` on; the next two are read while one is learnt from.

    Every picture with an object comes once, in an order and with changes (mirrored, brighter or darker) drawn from
    `seed` and `epoch`, so that a run that goes on sees what it would have seen.
    """
    order = epoch_order(data, seed, epoch)
    groups = [order[k : k + batch] for k in range(0, len(order), batch)]

    def read(number: int) -> Sample:
        return sample(data.pictures[number], np.random.default_rng([seed, 11, epoch, number]), torch)

    workers = min(_MOST_READERS, max(1, (os.cpu_count() or 1) // 2))
    with ThreadPoolExecutor(workers, thread_name_prefix="semdb-samples") as pool:
        waiting = [[pool.submit(read, number) for number in group] for group in groups[start : start + _AHEAD]]
        for position in range(start, len(groups)):
            current = [reading.result() for reading in waiting.pop(0)]
            if position + _AHEAD < len(groups):
                waiting.append([pool.submit(read, number) for number in groups[position + _AHEAD]])
            yield current


def epoch_order(data: CocoData, seed: int, epoch: int) -> list[int]:
    """Numbers of the pictures that show an object, shuffled."""
    shown = [k for k, picture in enumerate(data.pictures) if picture.instances]
    return [shown[k] for k in np.random.default_rng([seed, 10, epoch]).permutation(len(shown))]


def sample(picture: Picture, rng: np.random.Generator, torch: Any) -> Sample:
    """Image and target of a picture, changed by `rng`."""
    image = image_tensor(read_picture(picture), torch)
    masks = np.stack([mask_of(instance, picture) for instance in picture.instances])
    boxes = np.array([(x, y, x + w, y + h) for x, y, w, h in (i.box for i in picture.instances)], dtype=np.float32)
    boxes = np.clip(boxes, 0, [picture.width, picture.height, picture.width, picture.height]).astype(np.float32)
    image = (image * float(rng.uniform(0.7, 1.3))).clamp(0, 1)
    if rng.random() < 0.5:
        image, masks = image.flip(-1), masks[..., ::-1]
        boxes[:, [0, 2]] = picture.width - boxes[:, [2, 0]]
    keep = (boxes[:, 2] - boxes[:, 0] >= 1) & (boxes[:, 3] - boxes[:, 1] >= 1)
    labels = np.array([instance.label for instance in picture.instances], dtype=np.int64)
    target = {
        "boxes": torch.from_numpy(boxes[keep]),
        "labels": torch.from_numpy(labels[keep]),
        "masks": torch.from_numpy(np.ascontiguousarray(masks[keep]).astype(np.uint8)),
    }
    return image, target
