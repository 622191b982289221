"""Vectors of words by a sentence network in ONNX Runtime: what means nearly the same lies nearly in one direction.

The tokens are those of BERT (Devlin, Chang, Lee and Toutanova, NAACL 2019): small letters without accents, cut at
spaces and punctuation, and each word into the longest pieces that the vocabulary has (WordPiece).
"""

from __future__ import annotations

import unicodedata
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from semdb.errors import ModelError, UsageError
from semdb.perception.model_files import first_line, onnx_providers, onnx_sha256, resolve_onnx
from semdb.settings import Settings
from semdb.types import Float32Array, Int64Array, ModelInfo

VOCABULARY = "vocab.txt"  # beside the network
MOST_VOCABULARY = 16 << 20  # bytes
UNKNOWN, BEGIN, END = "[UNK]", "[CLS]", "[SEP]"
LONGEST_WORD = 100  # letters, of a word that is cut into pieces
MOST_TOKENS = 64
INPUTS = ("input_ids", "attention_mask", "token_type_ids")
OUTPUT = "last_hidden_state"


def load_words(settings: Settings) -> WordVectors | None:
    """The network of `SEMDB_WORDS`; None where it is not set.

    Raises UsageError for a spec that is none, ModelError for a file that is not there or no such network.
    """
    if settings.words is None:
        return None
    if not settings.words.startswith("onnx:"):
        raise UsageError(
            f"SEMDB_WORDS={settings.words}: write onnx:FILE, FILE being a sentence network with {VOCABULARY} beside it"
        )
    return WordVectors(settings.words, settings)


class WordVectors:
    """A network ``input_ids, attention_mask, token_type_ids [B, T]`` to ``last_hidden_state [B, T, d]``."""

    def __init__(self, spec: str, settings: Settings) -> None:
        """Opens the file of `spec` and the vocabulary beside it. Raises ModelError, naming what is wrong with which."""
        import onnxruntime as ort

        path = resolve_onnx(spec, settings)
        self._path = path
        self._numbers = read_vocabulary(path.parent / VOCABULARY)
        self.info = ModelInfo("words", f"onnx:{path.name}", onnx_sha256(path))
        options = ort.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1  # words are short
        options.log_severity_level = 3
        providers = onnx_providers("cpu", ort.get_available_providers())
        try:
            self._session = ort.InferenceSession(str(path), options, providers=providers)
        except Exception as error:  # ONNX Runtime's exceptions share no base class
            raise ModelError(f"{path} cannot be opened as an ONNX model ({first_line(error)})") from error
        inputs = {item.name for item in self._session.get_inputs()}
        outputs = {item.name for item in self._session.get_outputs()}
        if not inputs <= set(INPUTS) or "input_ids" not in inputs or OUTPUT not in outputs:
            raise ModelError(
                f"{path} is no network for words: it has {', '.join(sorted(inputs))} to {', '.join(sorted(outputs))}; "
                f"wanted are {', '.join(INPUTS)} to {OUTPUT}"
            )
        self._inputs = [name for name in INPUTS if name in inputs]

    def vectors(self, texts: Sequence[str]) -> Float32Array:
        """Unit vectors ``[n, d]`` of `texts`: the mean over their tokens. Raises ModelError when the network fails."""
        rows = [self._one(text) for text in texts]  # one by one: what else is asked for changes no vector
        return np.stack(rows) if rows else np.empty((0, 0), np.float32)

    def _one(self, text: str) -> Float32Array:
        tokens = tokens_of(text, self._numbers)
        given = {"input_ids": tokens, "attention_mask": np.ones_like(tokens), "token_type_ids": np.zeros_like(tokens)}
        try:
            (hidden,) = self._session.run([OUTPUT], {name: given[name][None] for name in self._inputs})
        except Exception as error:
            raise ModelError(f"{self._path} failed on {len(tokens)} tokens: {first_line(error)}") from error
        return _mean_direction(hidden, len(tokens), self._path)


def _mean_direction(hidden: Any, tokens: int, path: Path) -> Float32Array:
    if hidden.ndim != 3 or hidden.shape[:2] != (1, tokens):
        raise ModelError(f"{path}: {OUTPUT} is {hidden.shape} for {tokens} tokens; wanted is [1, {tokens}, d]")
    mean = hidden[0].astype(np.float64).mean(axis=0)
    length = float(np.linalg.norm(mean))
    if not np.isfinite(length) or length == 0:
        raise ModelError(f"{path} gave a vector that is zero or not finite: the file is damaged")
    vector: Float32Array = (mean / length).astype(np.float32)
    return vector


def read_vocabulary(path: Path) -> dict[str, int]:
    """Numbers of the tokens of a vocabulary, one a line. Raises ModelError for a file that is none."""
    try:
        if path.stat().st_size > MOST_VOCABULARY:
            raise ModelError(f"{path} is no vocabulary: it has more than {MOST_VOCABULARY >> 20} MB")
        lines = path.read_text(encoding="utf-8").splitlines()
    except UnicodeDecodeError:
        raise ModelError(f"{path} is no vocabulary: it is no text in UTF-8") from None
    except OSError as error:
        reason = error.strerror or "it cannot be read"
        raise ModelError(
            f"{path}: {reason}; the tokens of a sentence network are read from {VOCABULARY} beside it"
        ) from None
    numbers = {line.strip(): number for number, line in enumerate(lines)}
    missing = [token for token in (UNKNOWN, BEGIN, END) if token not in numbers]
    if missing:
        raise ModelError(f"{path} is no vocabulary of WordPiece: it has no {', '.join(missing)}")
    return numbers


def tokens_of(text: str, numbers: Mapping[str, int]) -> Int64Array:
    """Numbers ``[t]`` of the tokens of `text`, between those that begin and end it, `MOST_TOKENS` at most."""
    pieces = [piece for word in _words(text) for piece in _pieces(word, numbers)][: MOST_TOKENS - 2]
    return np.array([numbers[piece] for piece in (BEGIN, *pieces, END)], np.int64)


def _words(text: str) -> Iterator[str]:
    """Words in small letters without accents; each punctuation mark is one."""
    letters = unicodedata.normalize("NFD", text.lower())
    word = ""
    for letter in letters:
        kind = unicodedata.category(letter)
        if kind == "Mn":
            continue
        apart = letter.isspace() or kind[0] in "CZPS"
        if apart and word:
            yield word
            word = ""
        if kind[0] in "PS":
            yield letter
        elif not apart:
            word += letter
    if word:
        yield word


def _pieces(word: str, numbers: Mapping[str, int]) -> list[str]:
    """The longest pieces from the left that the vocabulary has; one unknown token where it has none for a part."""
    if len(word) > LONGEST_WORD:
        return [UNKNOWN]
    found: list[str] = []
    start = 0
    while start < len(word):
        mark = "##" if start else ""
        end = next((e for e in range(len(word), start, -1) if mark + word[start:e] in numbers), None)
        if end is None:
            return [UNKNOWN]
        found.append(mark + word[start:end])
        start = end
    return found
