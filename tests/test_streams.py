"""Streams of random numbers of one seed differ by name and number."""

import numpy as np

from trustbo.streams import stream


def test_one_name_gives_the_same_numbers_again():
    np.testing.assert_array_equal(stream(7, "score", 2).random(3), stream(7, "score", 2).random(3))


def test_names_numbers_and_seeds_give_other_numbers():
    generators = [
        np.random.default_rng(7),
        stream(7, "score"),
        stream(7, "score", 0),
        stream(7, "score", 1),
        stream(7, "reports", 1),
        stream(8, "score", 1),
    ]
    assert len({rng.random() for rng in generators}) == len(generators)
