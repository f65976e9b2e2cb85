"""Coefficients of modes as the command line gives them: ``MODE=VALUE``."""

from __future__ import annotations

import click


def mode_number(text: str, option: str) -> int:
    """Return the number of a mode, from 1; ``option`` is named where ``text`` is none.

    Raises
    ------
    click.BadParameter
        If it is none.

    Examples
    --------
    >>> mode_number(" 2 ", "--modes")
    2
    """
    if not text.strip().isdigit() or int(text) < 1:
        raise click.BadParameter(f"'{text.strip()}' is not the number of a mode (1, 2, ...)", param_hint=option)
    return int(text)


def coefficients(at: tuple[str, ...]) -> dict[int, float]:
    """Return coefficients by number of the mode, from 1.

    Raises
    ------
    click.BadParameter
        If one is not of the form ``MODE=VALUE``.

    Examples
    --------
    >>> coefficients(("1=-2", "3=0.5"))
    {1: -2.0, 3: 0.5}
    """
    found = {}
    for item in at:
        mode, _, value = item.partition("=")
        try:
            found[mode_number(mode, "--at")] = float(value)
        except ValueError as error:
            raise click.BadParameter(f"'{item}' is not MODE=VALUE, e.g. 1=-2", param_hint="--at") from error
    return found
