"""GTSAM's symbol keys, which name a robot and one of its poses.

`Symbol`: `letter << 56 | index`. `LabeledSymbol`: `letter << 56 | label << 48 | index`, of which
the label is the robot; some programs leave the letter out. Keys exceed 2^62 and would lose digits
as float64; everything here is int64.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Int

INDEX_BITS = 56
INDEX_LIMIT = 1 << INDEX_BITS
LABEL_BITS = 48
LABEL_LIMIT = 1 << LABEL_BITS
FIRST_LETTER, LAST_LETTER = 0x21, 0x7E  # printable ASCII, without the space


def letters_of(ids: Int[np.ndarray, " *n"]) -> Int[np.ndarray, " *n"]:
    """int64 `[n]`: the top byte of each id where that is a printable letter, else 0."""
    top = ids >> INDEX_BITS
    return np.where((top >= FIRST_LETTER) & (top <= LAST_LETTER), top, 0)


def labels_of(ids: Int[np.ndarray, " *n"]) -> Int[np.ndarray, " *n"]:
    """int64 `[n]`: letter and label, `id >> 48`, of labelled keys, else 0.

    A key is labelled when its byte 48–55 is printable, and its top byte is printable or zero: an
    index of a plain symbol would have to exceed 9e15 to look like that.
    """
    code = ids >> LABEL_BITS
    label, letter = code & 0xFF, code >> 8
    printable = (label >= FIRST_LETTER) & (label <= LAST_LETTER)
    known = (letter == 0) | ((letter >= FIRST_LETTER) & (letter <= LAST_LETTER))
    return np.where(printable & known, code, 0)


def are_symbols(ids: Int[np.ndarray, " n"]) -> bool:
    """True if there are ids and every one of them is a symbol key."""
    return bool(len(ids)) and bool((letters_of(ids) > 0).all())


def are_labelled(ids: Int[np.ndarray, " n"]) -> bool:
    """True where there are ids and every one of them is a labelled key."""
    return bool(len(ids)) and bool((labels_of(ids) > 0).all())


def indices_of(ids: Int[np.ndarray, " *n"]) -> Int[np.ndarray, " *n"]:
    """int64 `[n]`: each key's index; ids that are no keys unchanged."""
    index = np.where(letters_of(ids) > 0, ids & (INDEX_LIMIT - 1), ids)
    return np.where(labels_of(ids) > 0, ids & (LABEL_LIMIT - 1), index)


def keys(letter: str, indices: Int[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
    """int64 `[n]`: the keys of one letter's indices, each in 0 … 2^56 − 1."""
    return (np.int64(ord(letter)) << np.int64(INDEX_BITS)) | indices.astype(np.int64)


def with_indices(like: int, indices: Int[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
    """int64 `[n]`: keys of the robot that the key `like` is of; `indices` where it is no key."""
    key = np.array([like], np.int64)
    bits = LABEL_BITS if labels_of(key)[0] else INDEX_BITS if letters_of(key)[0] else None
    if bits is None:
        return indices.astype(np.int64)
    return (key >> bits << bits) | indices.astype(np.int64)


def key_of(text: str) -> int:
    """The key that "a12" stands for, or the integer that the text is.

    Raises:
        ValueError: for other text.
    """
    if text[:1].isalpha() and text[:1].isascii() and text[1:].isdigit():
        index = int(text[1:])
        if index < INDEX_LIMIT:
            return ord(text[0]) << INDEX_BITS | index
    return int(text)


def key_text(pose: int) -> str:
    """An id as messages show it: "b17" for a symbol key, "A17" for a labelled one, else digits."""
    key = np.array([pose], np.int64)
    code = int(labels_of(key)[0]) & 0xFF or int(letters_of(key)[0])
    return f"{chr(code)}{indices_of(key)[0]}" if code else str(pose)
