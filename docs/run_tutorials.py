"""Run the tutorials as they are printed: every ``sh`` and ``python`` block of ``docs/tutorials/*.md``, in order.

    python docs/run_tutorials.py                the six of them
    python docs/run_tutorials.py --quick        disk and curve only (these run in CI)
    python docs/run_tutorials.py NAME ...       these only
    python docs/run_tutorials.py --pictures     also draw docs/figures/tutorial_<name>.png again

Prints one row per tutorial: shapes, proved maps, description length and landmark error before and after, time. Exits with 1
when a command fails or a map is not proved. ``ssmpipe`` in a block is the package of this Python.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent
NAMES = ("femur-distal", "femur-proximal", "aorta", "closed", "disk", "curve")
QUICK = ("disk", "curve")


def blocks(page: str) -> list[tuple[str, str]]:
    """Return the language and the text of the blocks that are to be run."""
    return re.findall(r"^```(sh|python)\n(.*?)^```", page, flags=re.MULTILINE | re.DOTALL)


def run(name: str, folder: Path) -> dict[str, str]:
    """Run one tutorial in a folder; return the cells of its row."""
    tools = folder / ".tools"
    tools.mkdir()
    command = tools / "ssmpipe"
    command.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m ssmpipe "$@"\n')
    command.chmod(0o755)
    env = {**os.environ, "PATH": f"{tools}{os.pathsep}{os.environ['PATH']}"}
    begin = time.perf_counter()
    for language, text in blocks((HERE / "tutorials" / f"{name}.md").read_text(encoding="utf-8")):
        program = ["bash", "-euo", "pipefail", "-c", text] if language == "sh" else [sys.executable, "-c", text]
        done = subprocess.run(program, cwd=folder, env=env, capture_output=True, text=True, check=False)
        if done.returncode:
            raise SystemExit(f"{name}: exit code {done.returncode} of\n{text}\n{done.stdout}\n{done.stderr}")
    return {"tutorial": name, **result(folder / "out"), "time [s]": f"{time.perf_counter() - begin:.0f}"}


def result(out: Path) -> dict[str, str]:
    """Return what a run achieved."""
    (done,) = (path for path in out.iterdir() if (path / "cohort").is_dir())
    certificate = json.loads((done / "cohort/optimize/certificate.json").read_text())["shapes"]
    proved = sum(shape["status"] == "proved" for shape in certificate.values())
    if proved < len(certificate):
        raise SystemExit(f"{done}: only {proved} of {len(certificate)} maps are proved")
    with np.load(done / "cohort/optimize/correspondence.npz") as data:
        before, after = data["description_length"]
    return {
        "shapes": str(len(certificate)),
        "proved": str(proved),
        "description length": f"{before:.1f} to {after:.1f}",
        "landmarks [file units]": transfer(done / "cohort/evaluate/landmark_transfer.csv"),
    }


def transfer(path: Path) -> str:
    if not path.is_file():
        return "-"
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
    found = {row["correspondence"]: float(row["mean_mm"]) for row in rows if row["landmark"] == "all"}
    return f"{found['initial']:.2f} to {found['optimized']:.2f}" if found else "-"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help=f"of {', '.join(NAMES)}")
    parser.add_argument("--quick", action="store_true", help=f"only {' and '.join(QUICK)}")
    parser.add_argument("--pictures", action="store_true", help="draw the pictures again")
    parser.add_argument("--keep", type=Path, help="folder to run in, kept  [default: a temporary one]")
    options = parser.parse_args()
    names = options.names or (QUICK if options.quick else NAMES)
    printed = False
    for name in names:
        with tempfile.TemporaryDirectory() as temporary:
            folder = (options.keep or Path(temporary)) / name
            folder.mkdir(parents=True)
            row = run(name, folder)
            if options.pictures:
                sys.path.insert(0, str(HERE))
                from tutorial_pictures import draw

                draw(folder, HERE / "figures" / f"tutorial_{name}.png")
        if not printed:
            print("| " + " | ".join(row) + " |\n|" + "---|" * len(row))
            printed = True
        print("| " + " | ".join(row.values()) + " |", flush=True)


if __name__ == "__main__":
    main()
