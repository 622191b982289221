"""torch and ONNX Runtime on the CPU, the same networks, in one run: time by image size, and by batch.

``python -m bench.networks [RECORDING...] [--detector SPEC] [--encoder SPEC] [--repeats N] [--device D] [--json FILE]``

The specs are ``torchvision:`` ones; without them networks with random weights in the published architectures are
timed: ResNet-50-FPN, which calls some regions of the image an object and more of them weakly one, and ResNet-50. Images
are frames of the recordings, resized to each size. Prints the least of N runs of each, in turns, and torch's time over
ONNX Runtime's, which is what to compare. Time is processor time, so that other work on the machine matters little: with
one thread (SEMDB_THREADS=1) nearly that of a quiet one.

With ``--device`` (cuda, mps, cpu) torch alone runs there: images per second of `Describer.describe_batch` by the number
of images given at once, and the share of each stage; in wall time, on a CPU in processor time as above.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from semdb.cli.options import load_settings
from semdb.perception.describe import View, describer_from_specs
from semdb.perception.detectors import load_detector
from semdb.perception.encoders import load_encoder
from semdb.perception.onnx_export import export
from semdb.recordings import open_recordings
from semdb.settings import Settings
from semdb.types import Camera, ImageArray

SIZES = ((320, 240), (640, 480), (1280, 960))
BATCHES = (1, 2, 4, 8)
CHAIR, OBJECTS = 62, 10  # a class, and about how many of it a network with random weights is made to see


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="*", type=Path)
    parser.add_argument("--detector")
    parser.add_argument("--encoder")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--device")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    settings = load_settings(device=arguments.device or "cpu")
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        images = pictures(arguments.recordings)
        detector = arguments.detector or random_detector(folder / "detector.pth", images[0])
        encoder = arguments.encoder or random_encoder(folder / "encoder.pth")
        results: dict[str, Any] = {"threads": settings.threads, "device": settings.device}
        if arguments.device:
            results["describe"] = measure_describe(detector, encoder, images, settings, arguments.repeats)
        else:
            results["detector"] = measure_detector(detector, folder, images, settings, arguments.repeats)
            results["encoder"] = measure_encoder(encoder, folder, images, settings, arguments.repeats)
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(results, indent=2) + "\n")


def pictures(recordings: list[Path]) -> list[ImageArray]:
    """Up to eight frames of the recordings; smooth noise without any."""
    found = []
    for recording in [r for path in recordings for r in open_recordings(path)]:
        found += [recording.read(entry).image for entry in recording.entries[:: max(1, len(recording.entries) // 8)]]
    rng = np.random.default_rng(0)
    noise = [cv2.resize(rng.integers(0, 255, (30, 40, 3), dtype=np.uint8), (640, 480)) for _ in range(8)]
    return found[:8] or [np.asarray(image, dtype=np.uint8) for image in noise]


def measure_detector(
    spec: str, folder: Path, images: list[ImageArray], settings: Settings, repeats: int
) -> list[dict[str, Any]]:
    file = export(spec, folder / "detector.onnx", settings).path
    torch_one: Any = load_detector(spec, settings)
    onnx_one = load_detector(f"onnx:{file}", settings)
    rows = []
    for width, height in SIZES:
        image = cv2.resize(images[0], (width, height), interpolation=cv2.INTER_AREA)
        row = compare(lambda im=image: torch_one.detect(im, None), lambda im=image: onnx_one.detect(im, None), repeats)
        found = [one.weak for one in onnx_one.detect(image, None)]
        rows.append({"width": width, "height": height, "objects": found.count(False), "weak": sum(found), **row})
        show(f"detector {width}x{height}, {found.count(False)} objects and {sum(found)} weak ones", rows[-1])
    return rows


def measure_encoder(
    spec: str, folder: Path, images: list[ImageArray], settings: Settings, repeats: int
) -> list[dict[str, Any]]:
    file = export(spec, folder / "encoder.onnx", settings).path
    torch_one: Any = load_encoder(spec, settings)
    onnx_one = load_encoder(f"onnx:{file}", settings)
    rows = []
    for batch in BATCHES:
        chosen = [images[k % len(images)] for k in range(batch)]
        row = compare(
            lambda some=chosen: torch_one.encode_batch(some),
            lambda some=chosen: [onnx_one.encode(image) for image in some],
            repeats,
        )
        rows.append(
            {"batch": batch, **{name: value / (batch if name.endswith("ms") else 1) for name, value in row.items()}}
        )
        show(f"encoder, {batch} at once, per image", rows[-1])
    return rows


def measure_describe(
    detector: str, encoder: str, images: list[ImageArray], settings: Settings, repeats: int
) -> list[dict[str, Any]]:
    """Images of 640x480 described in batches; the first run of each size, which prepares the device, does not count."""
    describer = describer_from_specs(detector, encoder, "surf", settings)
    camera = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
    resized = [cv2.resize(image, (640, 480), interpolation=cv2.INTER_AREA) for image in images]
    clock = time.process_time if settings.device == "cpu" else time.perf_counter
    rows = []
    for batch in BATCHES:
        views = [View(resized[k % len(resized)], None, camera) for k in range(batch)]
        seconds, stages = [], []
        for repeat in range(repeats + 1):
            start = clock()
            described = describer.describe_batch(views)
            if repeat:
                seconds.append(clock() - start)
                stages += [one.timing_ms for one in described]
        whole = sum(sum(one.values()) for one in stages)
        shares = {name: sum(one[name] for one in stages) / whole for name in stages[0]}
        rows.append({"batch": batch, "images_per_s": batch / min(seconds), "shares": shares})
        parts = ", ".join(f"{name} {100 * share:.0f} %" for name, share in shares.items())
        print(f"describe, {batch} at once on {settings.device}: {rows[-1]['images_per_s']:.2f} images/s; {parts}")
        sys.stdout.flush()
    return rows


def compare(torch_work: Callable[[], object], onnx_work: Callable[[], object], repeats: int) -> dict[str, float]:
    """Milliseconds of processor time of both, in turns, after one run of each that does not count.

    The least of the runs: other work on the machine, which shares caches and memory, only adds.
    """
    times: dict[str, list[float]] = {"torch": [], "onnx": []}
    for repeat in range(repeats + 1):
        for name, work in (("torch", torch_work), ("onnx", onnx_work)):
            start = time.process_time()
            work()
            if repeat:
                times[name].append((time.process_time() - start) * 1000)
    least = {name: min(values) for name, values in times.items()}
    return {
        "torch_ms": least["torch"],
        "onnx_ms": least["onnx"],
        "torch_over_onnx": least["torch"] / least["onnx"],
    }


def show(what: str, row: dict[str, Any]) -> None:
    print(
        f"{what}: torch {row['torch_ms']:.0f} ms, ONNX Runtime {row['onnx_ms']:.0f} ms, "
        f"torch / ONNX Runtime {row['torch_over_onnx']:.2f}"
    )
    sys.stdout.flush()


def random_detector(path: Path, image: ImageArray) -> str:
    """A checkpoint with random weights that sees as much in `image` as a trained network in a kitchen; its spec.

    That is some ten objects and four times as many weak ones, whose masks ONNX files compute and torch does not.
    """
    import torch

    from semdb.perception.detectors.torchvision import image_tensor
    from semdb.perception.mask_rcnn import Architecture, build

    torch.manual_seed(0)
    network = build(Architecture("resnet50"), 91).eval()
    head = network.roi_heads.box_predictor
    with torch.inference_mode():
        head.bbox_pred.weight.mul_(0.1)
        head.cls_score.weight.mul_(2.5)  # as they come, one region is as sure as another: too many weak ones
        head.cls_score.bias[1:] -= 50.0
        head.cls_score.bias[CHAIR] += 30.0  # it or the background, and one number shifts all scores alike
        scores = network([image_tensor(image, torch)])[0]["scores"].double()
        head.cls_score.bias[CHAIR] -= float(torch.logit(scores[min(OBJECTS, len(scores) - 1)]))
    torch.save(network.state_dict(), path)
    return f"torchvision:{path}"


def random_encoder(path: Path) -> str:
    import torch
    import torchvision

    torch.manual_seed(0)
    torch.save(torchvision.models.resnet50(weights=None).state_dict(), path)
    return f"torchvision:{path}"


if __name__ == "__main__":
    main()
