import numpy as np
import pytest

from scas4d_core.metrics import adjusted_rand_index


def test_names_of_parts_do_not_matter_and_the_background_does_not_count():
    truth = np.array([[0, 1, 1], [0, 2, 2]])
    assert adjusted_rand_index(np.array([[5, 7, 7], [9, 3, 3]]), truth) == 1.0


def test_a_partition_counted_by_hand():
    # Pairs: together in both 1 + 3 = 4; in the truth 3 + 3 = 6; in the labels 1 + 6 = 7; of 15.
    # Expected 6·7/15 = 2.8.
    truth = np.array([[1, 1, 1, 2, 2, 2]])
    labels = np.array([[0, 0, 1, 1, 1, 1]])
    assert adjusted_rand_index(labels, truth) == pytest.approx((4 - 2.8) / (6.5 - 2.8))


def test_one_part_for_everything_is_worth_nothing():
    assert adjusted_rand_index(np.zeros((2, 4), int), np.array([[1, 1, 2, 2], [1, 1, 2, 2]])) == 0.0


def test_a_foreground_can_be_given():
    truth = np.array([[0, 0, 1, 1]])
    foreground = np.ones((1, 4), bool)
    assert adjusted_rand_index(np.array([[4, 4, 6, 6]]), truth, foreground) == 1.0
    assert adjusted_rand_index(np.array([[4, 6, 4, 6]]), truth, foreground) < 0


def test_faults_are_named():
    with pytest.raises(ValueError, match="no foreground pixels"):
        adjusted_rand_index(np.zeros((2, 2), int), np.zeros((2, 2), int))
    with pytest.raises(ValueError, match="ground-truth size"):
        adjusted_rand_index(np.zeros((2, 3), int), np.ones((2, 2), int))
