"""Words in messages: guess which known one was meant, put a number before a noun."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Return ``"; did you mean 'x'?"`` for the closest known word, or a list of the known ones when there are few.

    Examples
    --------
    >>> did_you_mean("decimat", ["decimate", "smooth"])
    "; did you mean 'decimate'?"
    >>> did_you_mean("xyz", ["b", "a"])
    '; known: a, b'
    """
    words = sorted(set(known))
    close = difflib.get_close_matches(
        word.lower().replace("_", "-"), [w.lower().replace("_", "-") for w in words], n=1, cutoff=0.6
    )
    if close:
        best = next(w for w in words if w.lower().replace("_", "-") == close[0])
        return f"; did you mean '{best}'?"
    return f"; known: {', '.join(words)}" if words and len(words) <= 20 else ""


def count(n: int, noun: str) -> str:
    """Return a number with its noun.

    Examples
    --------
    >>> count(1, "task"), count(2, "task")
    ('1 task', '2 tasks')
    """
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"
