import csv
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from ssmpipe.cli import main
from ssmpipe.io.meshes import read_mesh
from tests.support.models import curve_model, shape_model, write_model


def table(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(line for line in file if not line.startswith("#")))


def test_walks_and_random_instances(tmp_path: Path) -> None:
    model = shape_model("tube")
    result = write_model(model, tmp_path / "out")
    command = [
        "sample",
        str(result),
        "-o",
        str(tmp_path / "a"),
        "--modes",
        "1,2",
        "--steps",
        "3",
        "--n",
        "2",
        "--at",
        "2=-1.5",
    ]
    done = CliRunner().invoke(main, [*command, "--quads"])
    assert done.exit_code == 0, done.output
    rows = table(tmp_path / "a/instances.csv")
    names = ["mean"] + [f"mode_0{m}_{s}" for m in (1, 2) for s in ("minus3.00", "plus0.00", "plus3.00")]
    assert [row["name"] for row in rows] == [*names, "at_02=-1.5", "random_1", "random_2"]
    for row in rows:
        coefficients = [float(row[f"mode_0{m + 1}"]) for m in range(len(model.variances))]
        points = model.instance(np.array(coefficients))
        mesh = read_mesh(tmp_path / "a" / f"{row['name']}.ply")
        assert np.array_equal(mesh.vertices[: len(points)], points)
        assert float(row["mahalanobis"]) == pytest.approx(np.linalg.norm(coefficients))
        assert 0.5 < float(row["smallest_scaled_jacobian"]) <= float(row["mean_scaled_jacobian"]) <= 1
        quads = read_mesh(tmp_path / "a" / f"{row['name']}_quads.vtp")
        assert quads.n_faces == 2 * 12 * 8
    again = CliRunner().invoke(main, [*command[:3], str(tmp_path / "b"), *command[4:]])
    assert again.exit_code == 0
    for path in (tmp_path / "b").iterdir():
        assert path.read_bytes() == (tmp_path / "a" / path.name).read_bytes()


def test_curves_are_written_as_outlines(tmp_path: Path) -> None:
    result = write_model(curve_model(), tmp_path / "out")
    done = CliRunner().invoke(main, ["sample", str(result), "-o", str(tmp_path / "a"), "--modes", "none"])
    assert done.exit_code == 0, done.output
    assert sorted(p.name for p in (tmp_path / "a").iterdir()) == ["instances.csv", "mean.csv"]
    refused = CliRunner().invoke(main, ["sample", str(result), "-o", str(tmp_path / "b"), "--quads"])
    assert (refused.exit_code, "no quadrilaterals" in refused.output) == (2, True)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--modes", "99"], "there is no mode 99"),
        (["--modes", "first"], "'first' is not the number of a mode"),
        (["--at", "1:2"], "'1:2' is not MODE=VALUE"),
        (["--at", "9=1"], "there is no mode 9"),
    ],
)
def test_wrong_modes_are_refused(arguments: list[str], words: str, tmp_path: Path) -> None:
    result = write_model(shape_model(), tmp_path / "out")
    done = CliRunner().invoke(main, ["sample", str(result), "-o", str(tmp_path / "a"), *arguments])
    assert done.exit_code == 2
    assert words in done.output
    assert not (tmp_path / "a").exists()


def test_the_stage_of_the_same_name_stays_a_command(tmp_path: Path) -> None:
    done = CliRunner().invoke(main, ["sample", str(tmp_path / "no.ply"), str(tmp_path / "out.npz"), "--grid", "[9,9]"])
    assert done.exit_code == 3
    assert "no.ply" in done.output
    shown = CliRunner().invoke(main, ["sample", "--help"])
    assert shown.exit_code == 0
    assert "MODEL" in shown.output
    assert "--grid" in shown.output
