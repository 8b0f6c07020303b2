"""Bucketed sizes: large enough, few, and not too large; padding keeps the rows."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from jaxsonar.kernels.shape_buckets import bucket_size, next_power_of_two, pad_rows

counts = st.integers(0, 100_000)
smallest = st.sampled_from([2, 16, 64, 256])


@given(counts, smallest)
def test_buckets_hold_the_count_with_bounded_padding(count, least):
    size, power = bucket_size(count, least=least), next_power_of_two(count, least=least)
    assert max(count, least) <= size <= power
    assert size <= max(least, 1.5 * count)
    assert power <= max(least, 2 * count)


@given(counts, counts, smallest)
def test_buckets_are_monotonic_and_idempotent(one, other, least):
    for bucket in (bucket_size, next_power_of_two):
        assert (bucket(one, least=least) <= bucket(other, least=least)) or one > other
        size = bucket(one, least=least)
        assert bucket(size, least=least) == size


def test_few_buckets():
    assert len({bucket_size(count, least=32) for count in range(1, 10_000)}) == 18
    assert len({next_power_of_two(count, least=32) for count in range(1, 10_000)}) == 10


@given(st.integers(0, 20), st.integers(0, 20), st.sampled_from([0, -1, np.nan]))
def test_padding_keeps_rows_and_dtype(rows, more, fill):
    array = np.arange(2 * rows, dtype=np.float32).reshape(rows, 2)
    padded = pad_rows(array, rows + more, fill=fill)
    assert padded.dtype == array.dtype
    np.testing.assert_array_equal(padded[:rows], array)
    np.testing.assert_array_equal(padded[rows:], np.full((more, 2), fill, np.float32))
