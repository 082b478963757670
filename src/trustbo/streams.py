"""Named streams of random numbers, so that one seed serves several purposes independently.

Seeds such as `[seed, 1]` are easily used twice, and `default_rng([seed, 0])` equals
`default_rng(seed)`. Instead, the name of a stream is hashed into the key of its seed sequence,
which no list of seeds reproduces.
"""

import hashlib

import numpy as np


def stream(seed: int, name: str, *numbers: int) -> np.random.Generator:
    """Return the generator of a named stream.

    Args:
        seed: Seed, 0 or more.
        name: Purpose of the numbers; each use has its own name.
        numbers: Further numbers, such as that of a mission, that distinguish generators with one
            name.
    """
    key = int.from_bytes(hashlib.sha256(name.encode()).digest()[:4])  # 32 bits, as numpy needs
    sequence = np.random.SeedSequence(seed, spawn_key=(key, *numbers))
    return np.random.default_rng(sequence)
