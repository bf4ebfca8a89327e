"""Random numbers by counting: the generator Threefry-2x32 with 20 rounds [Salmon, Moraes, Dror & Shaw 2011].

A number is a function of its key and of two counters, so that any of them is found without those before it. It is the
generator behind JAX's keys; here in NumPy, which needs no program for every shape.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy

ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))
PARITY = np.uint32(0x1BD11BDA)

VALUES_PER_BLOCK = 1 << 15
"""Numbers that are made at once: they stay in the cache."""


def threefry(key, counter) -> tuple[np.ndarray, np.ndarray]:
    """Two words of 32 random bits for each pair of words of a key and each of a counter, which broadcast."""
    words = (*key, PARITY ^ key[0] ^ key[1])
    x, y = counter[0] + words[0], counter[1] + words[1]
    for group in range(5):
        for rotation in ROTATIONS[group % 2]:
            x = x + y
            y = (y << np.uint32(rotation) | y >> np.uint32(32 - rotation)) ^ x
        x, y = x + words[(group + 1) % 3], y + words[(group + 2) % 3] + np.uint32(group + 1)
    return x, y


def grid_seeds(seed: int, places: Sequence[np.ndarray]) -> np.ndarray:
    """A seed below 2^63 for each point of a grid, from one seed and its places along the axes, shape (points,) each."""
    count = len(places[0]) if places else 1
    key = np.full(count, seed >> 32, np.uint32), np.full(count, seed & 0xFFFFFFFF, np.uint32)
    for axis, place in enumerate(places):
        key = threefry(key, (np.asarray(place).astype(np.uint32), np.full(count, axis, np.uint32)))
    return (key[0].astype(np.int64) & 0x7FFFFFFF) << 32 | key[1].astype(np.int64)


def derive_key(key, *counters) -> tuple[np.ndarray, np.ndarray]:
    """The key that a chain of counters leads to from a key: each is encrypted with the words that the last one gave."""
    for counter in counters:
        key = threefry(key, tuple(np.asarray(word).astype(np.uint32) for word in counter))
    return key


def split_words(numbers) -> tuple[np.ndarray, np.ndarray]:
    """The high and the low 32 bits of integers of 64 bits; negative ones in two's complement."""
    numbers = np.asarray(numbers).astype(np.int64).view(np.uint64)
    return (numbers >> np.uint64(32)).astype(np.uint32), numbers.astype(np.uint32)


def normal_numbers(key, steps: np.ndarray, count: int) -> np.ndarray:
    """Normal numbers with the counters (step, place) under each key, shape (keys, steps, count).

    Parameters
    ----------
    key : two arrays of uint32, shape (keys,)
    steps : array of uint32, shape (steps,)
        The counters of the steps.
    count : int
        Normal numbers of a step.
    """
    numbers = np.empty((len(key[0]), len(steps), count))
    places = np.arange(count, dtype=np.uint32)
    portion = max(1, VALUES_PER_BLOCK // max(count, 1))
    together = max(1, portion // max(len(steps), 1))
    for i in range(0, len(numbers), together):
        keys = key[0][i : i + together, None, None], key[1][i : i + together, None, None]
        for start in range(0, len(steps), portion):
            high, low = threefry(keys, (steps[start : start + portion, None], places))
            bits = high.astype(np.uint64) << np.uint64(32) | low
            values = scipy.special.ndtri(((bits >> np.uint64(11)) + 0.5) * 2.0**-53)
            numbers[i : i + together, start : start + portion] = values
    return numbers
