import threading
import time

import pytest

from ssmpipe.core.blocks import map_blocks, side_by_side


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


def test_threads_inside_a_block_are_refused_in_place_of_a_deadlock():
    with pytest.raises(AssertionError, match="from inside a block"):
        map_blocks(lambda s: map_blocks(lambda t: t, 2, 1, 2), 2, 1, 2)
    assert map_blocks(lambda s: map_blocks(lambda t: t.stop, 2, 1), 2, 1, 2) == [[1, 2], [1, 2]]


def test_no_block_runs_on_when_the_call_has_failed():
    running = threading.Event()

    def function(s):
        if s.start == 0:
            running.wait(30)
            raise ValueError("the first fails while the second runs")
        running.set()
        time.sleep(0.05)
        done.append(s.start)

    done = []
    with pytest.raises(ValueError, match="the first fails"):
        map_blocks(function, 2, 1, 2)
    assert done == [1]


def test_an_interrupt_leaves_no_block_running_and_threads_usable():
    running, go_on = threading.Event(), threading.Event()

    def function(s):
        if threading.current_thread() is threading.main_thread():
            running.wait(30)
            go_on.set()
            raise KeyboardInterrupt
        running.set()
        go_on.wait(30)
        done.append(s.start)

    done = []
    with pytest.raises(KeyboardInterrupt):
        map_blocks(function, 6, 1, 2)
    assert len(done) == 1
    assert map_blocks(lambda s: s.stop, 2, 1, 2) == [1, 2]


@pytest.mark.parametrize("threads", [1, 2])
def test_side_by_side_returns_the_first_and_has_run_both(threads):
    seen = []
    assert side_by_side(lambda: "first", lambda: seen.append("second"), threads) == "first"
    assert seen == ["second"]
