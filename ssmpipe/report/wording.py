"""Numbers and names as a reader wants to see them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

CORRESPONDENCE_TITLES = {"initial": "before optimization", "optimized": "after optimization"}


def number(value: Any, digits: int = 3) -> str:
    """Return a number with ``digits`` significant digits, thousands apart, and an en dash when there is none.

    Examples
    --------
    >>> number(0.123456), number(26431), number(6.0), number(None), number(-1.5), number(1e-9)
    ('0.123', '26\u202f431', '6.00', '–', '−1.50', '1.00e−09')
    """
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, str):
        return value
    if value is None:
        return "–"
    if isinstance(value, (list, tuple)):
        return ", ".join(number(item, digits) for item in value)
    try:
        x = float(value)
    except (TypeError, ValueError):
        return str(value)
    if not math.isfinite(x):
        return "–"
    if x == 0 or isinstance(value, (int, np.integer)):
        text = f"{int(x):,}".replace(",", "\N{NARROW NO-BREAK SPACE}")
    elif abs(x) < 1e-4 or abs(x) >= 1e7:
        text = f"{x:.{digits - 1}e}"
    else:
        decimals = max(0, digits - 1 - math.floor(math.log10(abs(x))))
        text = f"{x:,.{decimals}f}".replace(",", "\N{NARROW NO-BREAK SPACE}")
    return text.replace("-", "−")


def percent(fraction: Any, digits: int = 0) -> str:
    """Return a fraction as percent.

    Examples
    --------
    >>> percent(0.923), percent(float("nan"))
    ('92\xa0%', '–')
    """
    x = float(fraction)
    return f"{100 * x:.{digits}f}\N{NO-BREAK SPACE}%" if math.isfinite(x) else "–"


def change(before: float, after: float) -> str:
    """Say in words how a number moved.

    Examples
    --------
    >>> change(2.0, 1.5), change(2.0, 2.5), change(2.0, 2.0)
    ('25\xa0% lower', '25\xa0% higher', 'unchanged')
    """
    if not (math.isfinite(before) and math.isfinite(after)) or before == 0:
        return "–"
    ratio = (after - before) / abs(before)
    if abs(ratio) < 0.005:
        return "unchanged"
    return f"{percent(abs(ratio))} {'lower' if ratio < 0 else 'higher'}"


def count(n: int, noun: str) -> str:
    """Return a count with its noun.

    Examples
    --------
    >>> count(1, "shape"), count(12, "shape")
    ('1 shape', '12 shapes')
    """
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"


def label(key: str) -> str:
    """Turn a metric key into words; a trailing unit goes into brackets.

    Examples
    --------
    >>> label("rms_to_surface_mm"), label("n_faces"), label("max_iterations")
    ('rms to surface [mm]', 'faces', 'max iterations')
    """
    words = key.split("_")
    unit = (
        words.pop()
        if len(words) > 1
        and words[-1] in {"mm", "mm2", "mm3", "s", "deg", "rad", "nat", "percent", "unit", "unit2", "unit3"}
        else ""
    )
    if words and words[0] == "n" and len(words) > 1:
        words = words[1:]
    return " ".join(words) + (
        f" [{unit.replace('2', '²').replace('3', '³').replace('percent', '%').replace('unit', 'file units')}]"
        if unit
        else ""
    )
