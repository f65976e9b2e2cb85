import threading

import pytest

from ssmpipe.core.blocks import map_blocks


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_order_and_slices_do_not_depend_on_the_threads(threads):
    assert map_blocks(lambda s: (s.start, s.stop), 11, 4, threads) == [(0, 2), (2, 5), (5, 8), (8, 11)]
    assert map_blocks(lambda s: s, 0, 4, threads) == []


def test_two_threads_meet_in_two_blocks():
    both = threading.Barrier(2, timeout=30)
    map_blocks(lambda s: both.wait(), 2, 1, 2)  # one thread alone would wait in vain


@pytest.mark.parametrize("bad", range(4))
def test_an_error_in_any_block_arrives(bad):
    def function(s):
        if s.start == bad:
            raise ValueError(f"block {bad}")

    with pytest.raises(ValueError, match=f"block {bad}"):
        map_blocks(function, 4, 1, 2)


@pytest.mark.parametrize("threads", [1, 2])
def test_blocks_inside_a_block_are_refused_in_place_of_a_deadlock(threads: int) -> None:
    with pytest.raises(AssertionError, match="called from inside a block"):
        map_blocks(lambda s: map_blocks(lambda t: t, 2, 1, threads), 2, 1, threads)
    assert map_blocks(lambda s: s.stop, 2, 1, threads) == [1, 2]  # the next call is outside again
