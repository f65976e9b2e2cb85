"""Egg-shaped outlines in any pose: the smallest cohort that goes through a whole chain with a common reference."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from click.testing import CliRunner

from ssmpipe.cli import main
from ssmpipe.core.outline.outline import Outline
from ssmpipe.io.outlines import write_outline


def write_eggs(folder: Path, numbers: range) -> Path:
    """Write one outline per number; the same number gives the same outline."""
    folder.mkdir(parents=True, exist_ok=True)
    rows = ["id,landmark,x,y"]
    for k in numbers:
        rng = np.random.default_rng(k)
        t = 2 * np.pi * np.arange(90) / 90
        width, tail = 30 + 2 * rng.normal(), 4 + 0.7 * rng.normal()
        points = np.column_stack(
            [width * np.cos(t) + tail * np.cos(2 * t), 18 * np.sin(t) + (3 + 0.6 * rng.normal()) * np.sin(3 * t)]
        )
        angle = rng.uniform(0, 6)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        points = points @ turn.T + 100
        rows += [f"egg{k},tip,{points[0, 0]},{points[0, 1]}", f"egg{k},back,{points[45, 0]},{points[45, 1]}"]
        points = np.roll(points, rng.integers(90), axis=0)
        write_outline(folder / f"egg{k}.csv", Outline(points if k % 2 else points[::-1], True))
    (folder / "landmarks.csv").write_text("\n".join(rows) + "\n")
    return folder


def ssmpipe(*args: object) -> tuple[int, str]:
    """Run a command; return exit code and all that was printed."""
    result = CliRunner().invoke(main, [str(a) for a in args])
    assert "Traceback" not in result.output
    return result.exit_code, result.output


def model_of_eggs(folder: Path, n: int = 6, **options: object) -> Path:
    """Run the chain of curves on some eggs, with more options of ``optimize``; return the output folder."""
    eggs = write_eggs(folder / "eggs", range(n))
    code, text = ssmpipe("init", "curve", eggs, "-o", folder / "eggs.yaml")
    assert code == 0, text
    chosen = {"landmarks": "[60]"} | options
    sets = [word for name, value in chosen.items() for word in ("--set", f"stages.optimize.{name}={value}")]
    code, text = ssmpipe("run", folder / "eggs.yaml", *sets, "-j", "1", "-q")
    assert code == 0, text
    return folder / "out" / "eggs"
