"""Counter-based random numbers: the generator Threefry-2x32 with 20 rounds [Salmon, Moraes, Dror & Shaw 2011].

Each number is a function of a key and two counters, so any number is computed without those before it. JAX's keys use
the same generator; this version in NumPy needs no compilation for each shape.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy

ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))
"""Rotation distances of the rounds, in bits, from the definition of Threefry-2x32."""
PARITY = np.uint32(0x1BD11BDA)
"""Parity constant of the key schedule, from the definition of Threefry."""

VALUES_PER_BLOCK = 1 << 15
"""Number of random numbers generated at once, small enough for the cache."""


def threefry(key, counter) -> tuple[np.ndarray, np.ndarray]:
    """Return two words of 32 random bits for each pair of a key and a counter; keys and counters are pairs of words
    that broadcast."""
    words = (*key, PARITY ^ key[0] ^ key[1])
    x, y = counter[0] + words[0], counter[1] + words[1]
    for group in range(5):
        for rotation in ROTATIONS[group % 2]:
            x = x + y
            y = (y << np.uint32(rotation) | y >> np.uint32(32 - rotation)) ^ x
        x, y = x + words[(group + 1) % 3], y + words[(group + 2) % 3] + np.uint32(group + 1)
    return x, y


def grid_seeds(seed: int, grid_indices: Sequence[np.ndarray]) -> np.ndarray:
    """Return a seed below 2^63 for each grid point, from one seed and the indices along each axis, shape (points,)."""
    count = len(grid_indices[0]) if grid_indices else 1
    key = np.full(count, seed >> 32, np.uint32), np.full(count, seed & 0xFFFFFFFF, np.uint32)
    for axis, axis_indices in enumerate(grid_indices):
        key = threefry(key, (np.asarray(axis_indices).astype(np.uint32), np.full(count, axis, np.uint32)))
    return (key[0].astype(np.int64) & 0x7FFFFFFF) << 32 | key[1].astype(np.int64)


def derive_key(key, *counters) -> tuple[np.ndarray, np.ndarray]:
    """Return the key derived from ``key`` by a chain of counters, each encrypted with the key derived so far."""
    for counter in counters:
        key = threefry(key, tuple(np.asarray(word).astype(np.uint32) for word in counter))
    return key


def split_words(numbers) -> tuple[np.ndarray, np.ndarray]:
    """Return the high and low 32 bits of 64-bit integers, negative ones in two's complement."""
    numbers = np.asarray(numbers).astype(np.int64).view(np.uint64)
    return (numbers >> np.uint64(32)).astype(np.uint32), numbers.astype(np.uint32)


def normal_numbers(key, steps: np.ndarray, count: int) -> np.ndarray:
    """Return normal random numbers for each key and step, shape (keys, steps, count).

    Parameters
    ----------
    key : two arrays of uint32, shape (keys,)
    steps : array of uint32, shape (steps,)
        The counters of the steps.
    count : int
        Normal numbers of a step.
    """
    numbers = np.empty((len(key[0]), len(steps), count))
    value_indices = np.arange(count, dtype=np.uint32)
    steps_per_block = max(1, VALUES_PER_BLOCK // max(count, 1))
    keys_per_block = max(1, steps_per_block // max(len(steps), 1))
    for i in range(0, len(numbers), keys_per_block):
        keys = key[0][i : i + keys_per_block, None, None], key[1][i : i + keys_per_block, None, None]
        for start in range(0, len(steps), steps_per_block):
            high_words, low_words = threefry(keys, (steps[start : start + steps_per_block, None], value_indices))
            bits = high_words.astype(np.uint64) << np.uint64(32) | low_words
            values = scipy.special.ndtri(((bits >> np.uint64(11)) + 0.5) * 2.0**-53)
            numbers[i : i + keys_per_block, start : start + steps_per_block] = values
    return numbers
