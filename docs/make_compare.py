"""Draw the pictures of docs/compare.md and print its figures.

    python docs/make_compare.py [--mouse RESULT]

Proximal femora by their true correspondence (`ssmpipe synth femur-proximal --groups`, seed 0), and, where a result of
configs/mouse_vertebra.yaml is given, the outlines of mouse vertebrae.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from ssmpipe.core.statistics.comparison import Options, Pair, compare_groups
from ssmpipe.report.comparison import difference_pictures
from ssmpipe.report.figures import CATEGORIES, SIGNED
from ssmpipe.use.groups import GroupOptions, load_cohort
from tests.support.groups import CamFemora, cam_femora

FIGURES = Path(__file__).resolve().parent / "figures"


def femur_figure(cohort: CamFemora, mean: np.ndarray, pair: Pair) -> plt.Figure:
    """Return the true mean bump, the map, and where it is significant, on one scale."""
    limit = 3.0
    nowhere = np.zeros(len(mean), dtype=bool)
    faces = cohort.sample.faces
    found = difference_pictures(mean, faces, np.asarray(pair.distance), pair.along_normal.q <= 0.05, limit)
    truth = difference_pictures(mean, faces, cohort.bump, nowhere, limit)
    drawn = [("true mean bump", truth[0][1]), ("cam − healthy", found[0][1]), ("q ≤ 0.05 only", found[2][1])]
    sheet, panels = plt.subplots(1, 3, figsize=(7.6, 3.1))
    for panel, (title, pixels) in zip(panels, drawn, strict=True):
        panel.imshow(pixels)
        panel.set_title(title, fontsize=9)
        panel.set_axis_off()
    scale = plt.cm.ScalarMappable(plt.Normalize(-limit, limit), SIGNED)
    sheet.colorbar(scale, ax=panels, shrink=0.7, label="mm, positive outside")
    return sheet


def report(title: str, pair: Pair) -> None:
    distance, tests = np.asarray(pair.distance), pair.along_normal
    print(
        f"{title}: modes {pair.joint.n_dimensions}, p {pair.joint.p:.4f}; whole {pair.whole.p:.4f}; anywhere {pair.p_anywhere:.4f}; "
        f"distance {distance.min():.2f} to {distance.max():.2f}; q <= 0.05 {100 * (tests.q <= 0.05).mean():.1f} %; sorted "
        f"{100 * pair.classification.accuracy:.0f} % ({100 * pair.classification.low:.0f}-{100 * pair.classification.high:.0f})"
    )


def femora() -> None:
    for seed in range(4):
        cohort = cam_femora(seed, 3.2)
        for paired in (False, True):
            found = compare_groups(cohort.sample, Options(paired=paired))
            pair, bump = found.pairs[0], cohort.bump
            report(f"femora, seed {seed}{', paired' if paired else ''}", pair)
            on, off = bump > 0.5 * bump.max(), bump < 0.02 * bump.max()
            away = np.linalg.norm(found.mean[np.asarray(pair.distance).argmax()] - found.mean[bump.argmax()])
            for name, values in (("q", pair.along_normal.q), ("family-wise", pair.along_normal.p_family)):
                print(f"    {name} <= 0.05: {100 * (values[on] <= 0.05).mean():.0f} % of the bump, "
                      f"{100 * (values[off] <= 0.05).mean():.1f} % off it; peak {away:.1f} mm from the true one, "
                      f"{np.max(pair.distance):.2f} of {bump.max():.2f} mm")  # fmt: skip
            if seed == 0 and not paired:
                drawn = femur_figure(cohort, found.group_means[0], pair)
                drawn.savefig(FIGURES / "compare_femora.png", dpi=110, bbox_inches="tight")


def mice(result: Path) -> None:
    cohort = load_cohort(result, None, GroupOptions())
    found = compare_groups(cohort.sample, Options())
    sheet, panels = plt.subplots(1, 3, figsize=(9.5, 3.4))
    for panel, pair in zip(panels, found.pairs, strict=True):
        names = cohort.groups[pair.second], cohort.groups[pair.first]
        report(" - ".join(names), pair)
        strong = pair.along_normal.q <= 0.05
        for group in (pair.first, pair.second):
            points = found.group_means[group]
            panel.plot(
                *np.concatenate([points, points[:1]]).T, color=CATEGORIES[group], lw=1, label=cohort.groups[group]
            )
            panel.plot(*np.where(strong[:, None], points, np.nan).T, color=CATEGORIES[group], lw=3.2)
        panel.set_aspect("equal")
        panel.set_axis_off()
        panel.legend(loc="lower center", ncols=2, fontsize=8, frameon=False, bbox_to_anchor=(0.5, -0.12))
        panel.set_title(f"{names[0]} − {names[1]}", fontsize=9)
    sheet.savefig(FIGURES / "compare_mice.png", dpi=110, bbox_inches="tight")
    print(f"all: sorted {100 * found.classification.accuracy:.0f} %, T2 modes p {found.joint.p:.4f}")


def main() -> None:
    """Write the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mouse", type=Path, metavar="RESULT", help="output folder of configs/mouse_vertebra.yaml")
    arguments = parser.parse_args()
    if arguments.mouse:
        mice(arguments.mouse)
    femora()


if __name__ == "__main__":
    main()
