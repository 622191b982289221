"""Words that people say for classes: other names, kinds of things, and what things are good for.

Classes are those of COCO, and whatever a detector brings: those are understood by their own names. The tables are in
docs/landmarks.md.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from semdb.errors import UsageError
from semdb.types import Float32Array

LEAST_COSINE = 0.55  # of a word with one that is known, before it is taken for it
HINT_COSINE = 0.4  # before it is offered
Vectors = Callable[[Sequence[str]], Float32Array]  # texts to unit vectors [n, d]

SYNONYMS: Mapping[str, str] = {
    "armchair": "chair",
    "bag": "handbag",
    "ball": "sports ball",
    "beaker": "cup",
    "bike": "bicycle",
    "cellphone": "cell phone",
    "computer": "laptop",
    "desk": "dining table",
    "display": "tv",
    "flower": "potted plant",
    "flowers": "potted plant",
    "flower pot": "potted plant",
    "fridge": "refrigerator",
    "glass": "wine glass",
    "hair dryer": "hair drier",
    "human": "person",
    "lavatory": "toilet",
    "loo": "toilet",
    "mobile": "cell phone",
    "mobile phone": "cell phone",
    "monitor": "tv",
    "motorbike": "motorcycle",
    "mug": "cup",
    "notebook": "laptop",
    "phone": "cell phone",
    "plant": "potted plant",
    "plane": "airplane",
    "rucksack": "backpack",
    "screen": "tv",
    "settee": "couch",
    "smartphone": "cell phone",
    "sofa": "couch",
    "stool": "chair",
    "stove": "oven",
    "table": "dining table",
    "teddy": "teddy bear",
    "telephone": "cell phone",
    "television": "tv",
    "telly": "tv",
    "wash basin": "sink",
    "washbasin": "sink",
    "wineglass": "wine glass",
}

KINDS: Mapping[str, tuple[str, ...]] = {
    "accessory": ("backpack", "handbag", "suitcase", "tie", "umbrella"),
    "animal": ("bear", "bird", "cat", "cow", "dog", "elephant", "giraffe", "horse", "sheep", "zebra"),
    "appliance": ("microwave", "oven", "refrigerator", "sink", "toaster"),
    "crockery": ("bowl", "cup", "wine glass"),
    "cutlery": ("fork", "knife", "spoon"),
    "device": ("cell phone", "keyboard", "laptop", "mouse", "remote", "tv"),
    "electronics": ("cell phone", "keyboard", "laptop", "mouse", "remote", "tv"),
    "food": ("apple", "banana", "broccoli", "cake", "carrot", "donut", "hot dog", "orange", "pizza", "sandwich"),
    "fruit": ("apple", "banana", "orange"),
    "furniture": ("bed", "bench", "chair", "couch", "dining table", "potted plant", "toilet"),
    "kitchenware": ("bottle", "bowl", "cup", "fork", "knife", "spoon", "wine glass"),
    "luggage": ("backpack", "handbag", "suitcase"),
    "seat": ("bench", "chair", "couch"),
    "tableware": ("bottle", "bowl", "cup", "fork", "knife", "spoon", "wine glass"),
    "toy": ("kite", "sports ball", "teddy bear"),
    "vehicle": ("airplane", "bicycle", "boat", "bus", "car", "motorcycle", "train", "truck"),
}

# what for: affordances, with other ways to say them
GOOD_FOR: Mapping[str, tuple[str, ...]] = {
    "drink-from": ("cup", "wine glass", "bottle"),
    "sit-on": ("chair", "couch", "bench"),
    "lie-on": ("bed", "couch"),
    "heat-food": ("microwave", "oven", "toaster"),
    "cool-food": ("refrigerator",),
    "eat-with": ("fork", "knife", "spoon"),
    "eat-from": ("bowl",),
    "wash-in": ("sink",),
    "write-on": ("keyboard", "laptop"),
    "read": ("book",),
    "watch": ("tv", "laptop"),
    "call-with": ("cell phone",),
    "cut-with": ("knife", "scissors"),
    "carry-things": ("backpack", "handbag", "suitcase"),
    "put-things-on": ("dining table", "bench"),
    "tell-time": ("clock",),
}
SAID_AS: Mapping[str, str] = {
    "something to sit on": "sit-on",
    "somewhere to sit": "sit-on",
    "a place to sit": "sit-on",
    "something to lie on": "lie-on",
    "somewhere to sleep": "lie-on",
    "something to drink from": "drink-from",
    "something to drink out of": "drink-from",
    "something to eat with": "eat-with",
    "something to eat from": "eat-from",
    "something to heat food": "heat-food",
    "something to heat food with": "heat-food",
    "something to read": "read",
    "something to write on": "write-on",
    "something to cut with": "cut-with",
    "something to watch": "watch",
    "something to eat": "food",
    "somewhere to put things": "put-things-on",
    "something to wash in": "wash-in",
}


@dataclass(frozen=True, slots=True)
class Understood:
    """What a word was taken for: `classes`, by `how` (class, synonym, kind, use or vector).

    By its vector it was taken for `like`, a word that is known; `cosine` is that of the two.
    """

    said: str
    classes: tuple[str, ...]
    how: str
    like: str | None = None
    cosine: float | None = None

    def as_dict(self) -> dict[str, object]:
        """What JSON has."""
        by_vector = {} if self.like is None else {"like": self.like, "cosine": self.cosine}
        return {"said": self.said, "classes": list(self.classes), "how": self.how, **by_vector}


def understand(said: str, known: Collection[str], vectors: Callable[[], Vectors | None] = lambda: None) -> Understood:
    """The classes that somebody means by a word. `known` are the names of the classes of the database.

    A word that is in no table is taken for the one whose vector is nearest, where `vectors`, which is asked only then,
    has something that makes them. Raises UsageError for a word that is none, with what is like it.
    """
    word = " ".join(said.strip().lower().split())
    names = {name.lower(): name for name in sorted(known)}
    for form in _forms(word):
        if form in names:
            return Understood(said, (names[form],), "class")
    for form in _forms(word):
        if form in SYNONYMS:
            return Understood(said, (SYNONYMS[form],), "synonym")
        if form in KINDS:
            return Understood(said, KINDS[form], "kind")
        use = SAID_AS.get(form, form.replace(" ", "-"))
        if use in GOOD_FOR:
            return Understood(said, GOOD_FOR[use], "use")
        if use in KINDS:
            return Understood(said, KINDS[use], "kind")
    for form in _forms(word):
        if form in _every_class():
            return Understood(said, (form,), "class")
    choices = sorted({*names, *SYNONYMS, *KINDS, *GOOD_FOR, *_every_class()})
    near = difflib.get_close_matches(word, choices, 3)
    make = vectors()
    if make is not None:
        found, alike = _nearest(said, _forms(word)[0], _phrases(known), make)
        if found is not None:
            return found
        near = list(dict.fromkeys([*near, *alike]))[:3]
    hint = f"; did you mean {', '.join(near)}?" if near else ""
    raise UsageError(f"{said!r} is no class of this database, and no word for one{hint}")


def _phrases(known: Collection[str]) -> dict[str, tuple[str, ...]]:
    """All that can be said, with what it means."""
    found: dict[str, tuple[str, ...]] = {name: (name,) for name in sorted({*known, *_every_class()})}
    found |= {word: (name,) for word, name in SYNONYMS.items() if word not in found}
    found |= {word: names for word, names in KINDS.items() if word not in found}
    found |= {use.replace("-", " "): names for use, names in GOOD_FOR.items()}
    return found | {word: GOOD_FOR.get(use) or KINDS[use] for word, use in SAID_AS.items()}


def _nearest(
    said: str, word: str, phrases: Mapping[str, tuple[str, ...]], make: Vectors
) -> tuple[Understood | None, list[str]]:
    """What `word` is taken for by vectors, and the three phrases that are most like it."""
    texts = list(phrases)
    cosines = make(texts).astype(np.float64) @ make([word])[0]
    order = np.argsort(-cosines, kind="stable")[:3]
    best = int(order[0])
    alike = [texts[k] for k in order if cosines[k] >= HINT_COSINE]
    if cosines[best] < LEAST_COSINE:
        return None, alike
    cosine = round(float(cosines[best]), 3)
    return Understood(said, phrases[texts[best]], "vector", texts[best], cosine), alike


def _forms(word: str) -> list[str]:
    """A word without article, and in the singular."""
    for article in ("a ", "an ", "the "):
        if word.startswith(article):
            word = word.removeprefix(article)
            break
    forms = [word]
    for ending, single in (("ves", "fe"), ("ies", "y"), ("es", ""), ("s", "")):
        if word.endswith(ending) and len(word) > len(ending) + 2:
            forms.append(word.removesuffix(ending) + single)
    return forms


def _every_class() -> frozenset[str]:
    return frozenset({*SYNONYMS.values(), *(c for classes in (*KINDS.values(), *GOOD_FOR.values()) for c in classes)})
