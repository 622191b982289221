"""Small objects that lie on furniture, and what a second visit finds moved."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semdb.recordings.synthetic import furniture as f
from semdb.recordings.synthetic.furniture import Palette
from semdb.recordings.synthetic.scene import Material, Prim, Texture, ball, box
from semdb.recordings.synthetic.textures import speckle


@dataclass(frozen=True, slots=True)
class Small:
    """`radius` of the footprint and `height` in metres; whether it is put facing the front."""

    radius: float
    height: float
    faces_front: bool = False


SMALL = {
    "apple": Small(0.05, 0.08),
    "banana": Small(0.1, 0.04),
    "book": Small(0.15, 0.05),
    "bottle": Small(0.06, 0.3),
    "bowl": Small(0.14, 0.08),
    "cell phone": Small(0.09, 0.01),
    "cup": Small(0.07, 0.1),
    "keyboard": Small(0.2, 0.03, True),
    "laptop": Small(0.2, 0.25, True),
    "microwave": Small(0.27, 0.3, True),
    "mouse": Small(0.06, 0.04),
    "orange": Small(0.05, 0.08),
    "potted plant": Small(0.12, 0.32),
    "remote": Small(0.09, 0.02),
    "scissors": Small(0.09, 0.01),
    "teddy bear": Small(0.18, 0.42, True),
    "toaster": Small(0.17, 0.2, True),
    "vase": Small(0.11, 0.4),
    "wine glass": Small(0.06, 0.18),
}


def make_small(p: Palette, category: str) -> list[Prim]:
    """The primitives of a small object of a class of `SMALL`; origin at the centre of its base."""
    if category == "apple":
        return f.fruit(p, (176, 44, 40))
    if category == "orange":
        return f.fruit(p, (224, 132, 34))
    if category == "banana":
        return _banana(p)
    if category == "scissors":
        return _scissors(p)
    if category in ("cup", "vase"):
        glaze = p.pots[int(p.rng.integers(3))] if category == "cup" else p.pick(p.pots)
        return f.cup(p, glaze) if category == "cup" else f.vase(p, glaze)
    if category == "bottle":
        return f.bottle(p, p.pick(p.bottles))
    if category == "bowl":
        return f.bowl(p, p.pick(p.pots))
    if category == "potted plant":
        return f.plant(p, p.pick(p.pots), 0.34)
    makers = {
        "book": f.lying_book,
        "cell phone": f.cell_phone,
        "keyboard": f.keyboard,
        "laptop": f.laptop,
        "microwave": f.microwave,
        "mouse": f.mouse,
        "remote": f.remote,
        "teddy bear": f.teddy_bear,
        "toaster": f.toaster,
        "wine glass": f.wine_glass,
    }
    return makers[category](p)


def _banana(p: Palette) -> list[Prim]:
    skin = Material(Texture(speckle(p.rng, (220, 186, 60), 0.12)))
    angles = np.linspace(-0.7, 0.7, 5)
    return [
        ball((0.1 * np.sin(a), 0.1 * np.cos(a) - 0.08, 0.018), (0.028, 0.018, 0.018), skin, (0, 0, -a)) for a in angles
    ]


def _scissors(p: Palette) -> list[Prim]:
    prims = [box((0.02 * s, 0.03, 0), (0.012, 0.12, 0.005), p.metal, (0, 0, 0.16 * s)) for s in (-1, 1)]
    return [*prims, *(ball((0.022 * s, -0.05, 0.006), (0.02, 0.03, 0.006), p.wood[0]) for s in (-1, 1))]
