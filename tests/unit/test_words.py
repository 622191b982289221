"""Words by their vectors: tokens, what a word is taken for, and files that are no network for words."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from semdb.errors import ModelError, UsageError
from semdb.landmarks.words import understand
from semdb.perception.word_vectors import MOST_TOKENS, WordVectors, load_words, read_vocabulary, tokens_of
from semdb.settings import Settings
from semdb.types import Float32Array

VOCABULARY = {
    token: k for k, token in enumerate(["[UNK]", "[CLS]", "[SEP]", "cafe", "cup", "##s", "##board", "-", "a"])
}
CLASSES = ("cup", "chair", "sink")


@pytest.mark.parametrize(
    ("text", "tokens"),
    [
        ("Cups", [4, 5]),
        ("  Café-cup ", [3, 7, 4]),
        ("cupboards", [4, 6, 5]),
        ("mug cup", [0, 4]),
        ("", []),
        ("\x00a\ufffd", [8, 0]),
    ],
)
def test_tokens(text: str, tokens: list[int]) -> None:
    assert tokens_of(text, VOCABULARY).tolist() == [1, *tokens, 2]


def test_tokens_are_so_many_at_most() -> None:
    assert len(tokens_of("cup " * 1000, VOCABULARY)) == MOST_TOKENS
    assert tokens_of("x" * 1000, VOCABULARY).tolist() == [1, 0, 2]


def made(texts: Sequence[str]) -> Float32Array:
    """Vectors in which a goblet is nearly a cup, and a lamp nothing."""
    places = {"cup": (1, 0, 0), "goblet": (0.8, 0.6, 0), "lamp": (0.5, 0, 0.866), "chair": (0, 1, 0)}
    return np.array([places.get(text, (0, 0, -1)) for text in texts], np.float32)


def test_a_word_is_taken_for_the_nearest() -> None:
    found = understand("the Goblet", CLASSES, lambda: made)
    assert (found.classes, found.how, found.like, found.cosine) == (("cup",), "vector", "cup", 0.8)
    assert found.as_dict() == {
        "said": "the Goblet",
        "classes": ["cup"],
        "how": "vector",
        "like": "cup",
        "cosine": 0.8,
    }
    with pytest.raises(UsageError, match=r"'lamp' is no class .* did you mean .*cup"):
        understand("lamp", CLASSES, lambda: made)


def test_tables_come_before_vectors() -> None:
    def never() -> None:
        raise AssertionError

    assert understand("mug", CLASSES, never).as_dict() == {"said": "mug", "classes": ["cup"], "how": "synonym"}


def test_what_is_no_network_for_words(tmp_path: Path) -> None:
    assert load_words(Settings()) is None
    with pytest.raises(UsageError, match="write onnx:FILE"):
        load_words(Settings(words="minilm"))
    with pytest.raises(ModelError, match="no model file at"):
        load_words(Settings(words="onnx:none.onnx", cache_dir=tmp_path))
    file = tmp_path / "words.onnx"
    file.write_bytes(b"no model")
    with pytest.raises(ModelError, match=r"vocab\.txt: No such file.* beside it"):
        load_words(Settings(words=f"onnx:{file}"))
    (tmp_path / "vocab.txt").write_bytes(b"\xff\xfe")
    with pytest.raises(ModelError, match="no text in UTF-8"):
        read_vocabulary(tmp_path / "vocab.txt")
    (tmp_path / "vocab.txt").write_text("cup\n")
    with pytest.raises(ModelError, match=r"has no \[UNK\], \[CLS\], \[SEP\]"):
        read_vocabulary(tmp_path / "vocab.txt")
    (tmp_path / "vocab.txt").write_text("\n".join(VOCABULARY))
    with pytest.raises(ModelError, match="cannot be opened"):
        load_words(Settings(words=f"onnx:{file}"))


def test_a_network_of_something_else(shared_dir: Path, tmp_path: Path) -> None:
    (tmp_path / "vocab.txt").write_text("\n".join(VOCABULARY))
    file = tmp_path / "encoder.onnx"
    file.symlink_to(shared_dir / "models/mobilenet_v2_imagenet.onnx")
    with pytest.raises(ModelError, match="is no network for words: it has image to"):
        load_words(Settings(words=f"onnx:{file}"))


def test_a_real_network(shared_dir: Path) -> None:
    network = WordVectors(f"onnx:{shared_dir}/models/minilm/minilm_l6_int8.onnx", Settings())
    vectors = network.vectors(["mug", "cup", "sofa", "couch"])
    assert vectors.shape == (4, 384)
    assert np.linalg.norm(vectors, axis=1) == pytest.approx(1, abs=1e-6)
    cosines = vectors @ vectors.T
    assert cosines[0, 1] > 0.6 > cosines[0, 2]
    assert network.vectors(["cup"])[0].tobytes() == vectors[1].tobytes()  # whatever else is asked for
    assert len(network.info.sha256) == 64
    found = understand("espresso cup", ("cup", "sink"), lambda: network.vectors)
    assert (found.classes, found.like) == (("cup",), "cup")
