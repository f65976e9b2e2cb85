"""Take the outlines of mouse vertebrae from files to report, measure, and write ``docs/mouse_vertebra.md``.

    python docs/make_mouse_vertebra.py --data FOLDER [--work FOLDER]

FOLDER: a folder with ``contours``, ``cohort.csv`` and ``landmarks.csv``.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))

import make_thesis  # noqa: E402

from ssmpipe.core.model.pca import principal_components  # noqa: E402
from ssmpipe.io.tables import read_table  # noqa: E402


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--work", type=Path)
    arguments = parser.parse_args()
    work = arguments.work or Path(tempfile.mkdtemp())
    rows, text = make_thesis.outlines(work, arguments.data)
    cohort = work / "outlines" / "cohort"
    transfer = read_table(cohort / "evaluate" / "landmark_transfer.csv").columns
    names = list(dict.fromkeys(transfer["landmark"]))
    lines = ["| landmark | before, mean | after, mean |", "|---|---|---|"]
    for name in names:
        before, after = make_thesis.transfer(work / "outlines", name)
        lines.append(f"| {name} | {before:.2f} | {after:.2f} |")
    with np.load(cohort / "optimize" / "correspondence.npz") as found:
        before, after = (principal_components(found[key])[2] for key in ("initial_points", "points"))
        n_shapes = len(found["ids"])
    body = text.split("\n", 2)[2]
    page = f"""# Mouse vertebrae: closed outlines from files to groups

Made by `python docs/make_mouse_vertebra.py`; {n_shapes} public outlines of T2 vertebrae (O'Higgins and Johnson; Dryden and Mardia,
*Statistical Shape Analysis*), about 60 points each, in three groups of mice. Lengths in units of the digitizer.

```sh
ssmpipe run configs/mouse_vertebra.yaml --set input.scans='FOLDER/contours/*.csv' --set input.cohort=FOLDER/cohort.csv \\
    --set input.landmarks=FOLDER/landmarks.csv
```

## Landmarks

Six expert landmarks an outline, carried from every outline to every other one; they lie up to 4.5 units beside the outline. The
engine does not see them: {rows[0][3]} in the mean.

{chr(10).join(lines)}

Share of the first mode {100 * before[0] / before.sum():.1f} % before, {100 * after[0] / after.sum():.1f} % after.

## Groups

{body}"""
    (HERE / "mouse_vertebra.md").write_text(page, encoding="utf-8")


if __name__ == "__main__":
    main()
