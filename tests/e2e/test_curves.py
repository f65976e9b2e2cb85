"""Planar outlines and spline files from the command line to the report."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from ssmpipe.cli import main
from ssmpipe.core.outline.outline import Outline
from ssmpipe.io.outlines import read_outline, write_outline
from ssmpipe.io.splines import read_spline

MOUSE = Path(__file__).parents[2] / "../shared/data/mouse_vertebra"


def ssmpipe(*args: object) -> tuple[int, str]:
    result = CliRunner().invoke(main, [str(a) for a in args])
    assert "Traceback" not in result.output
    return result.exit_code, result.output


@pytest.fixture
def outlines(tmp_path: Path) -> Path:
    folder = tmp_path / "outlines"
    folder.mkdir()
    rows = ["id,landmark,x,y"]
    for k in range(5):
        rng = np.random.default_rng(k)
        t = 2 * np.pi * np.arange(90) / 90
        points = np.column_stack([(30 + 2 * k) * np.cos(t) + 4 * np.cos(2 * t), 18 * np.sin(t) + 3 * np.sin(3 * t)])
        angle = rng.uniform(0, 6)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        points = points @ turn.T + 100
        rows += [f"egg{k},tip,{points[0, 0]},{points[0, 1]}", f"egg{k},back,{points[45, 0]},{points[45, 1]}"]
        points = np.roll(points, rng.integers(90), axis=0)
        write_outline(folder / f"egg{k}.csv", Outline(points if k % 2 else points[::-1], True))
    (folder / "landmarks.csv").write_text("\n".join(rows) + "\n")
    return folder


def test_init_check_run_and_refuse(tmp_path: Path, outlines: Path) -> None:
    config = tmp_path / "eggs.yaml"
    code, text = ssmpipe("init", "curve", outlines, "-o", config)
    assert (code, text.splitlines()[0]) == (0, f"5 scans in {outlines}; config written to {config}")
    assert "units: none" in config.read_text()
    assert "parameters: " in config.read_text(), "options of the outline variant"
    code, text = ssmpipe("check", config)
    assert code == 0, text
    assert "5 of 5 scans can be used" in text
    quick = ("--set", "stages.optimize.landmarks=[60]", "-j", "1", "-q")
    code, text = ssmpipe("run", config, *quick)
    assert code == 0, text
    out = tmp_path / "out" / "eggs"
    assert (out / "shapes/egg0/01-contour/contour.csv").is_file()
    assert (out / "report.html").stat().st_size > 10_000
    with np.load(out / "cohort/optimize/correspondence.npz") as found:
        assert str(found["topology"]) == "curve-closed"
        assert found["points"].shape == (5, 60, 2)
        for shape, points in zip(found["ids"], found["points_scan"], strict=True):
            raw = read_outline(outlines / f"{shape}.csv")
            gaps = np.sqrt(((points[:, None] - raw.points) ** 2).sum(axis=-1)).min(axis=1)
            assert gaps.max() < 2.0, "points_scan lie on the outline as it was in the file"
    assert read_outline(out / "cohort/model/mean.csv").closed
    assert json.loads((out / "cohort/optimize/certificate.json").read_text())["all_proved"]
    rows = (out / "cohort/evaluate/landmark_transfer.csv").read_text().splitlines()
    assert float(next(r for r in rows if r.startswith("all,optimized")).split(",")[4]) < 3.0
    told = json.loads((out / "run.json").read_text())
    stages = [*told["cohort_stages"], *(t for shape in told["shapes"].values() for t in shape["stages"])]
    names = {name for stage in stages for name in stage.get("metrics", {})}
    assert {"generalization_1_mode_optimized_unit", "landmark_transfer_optimized_unit", "length_unit"} <= names
    assert [name for name in names if name.endswith("_mm")] == [], "lengths have no unit here"
    assert "RMS per point [file units]" in (out / "cohort/evaluate/measures.csv").read_text().splitlines()[0]
    assert "[mm" not in rows[0]
    assert "columns whose names end in _mm are in file units" in rows[0]
    assert ssmpipe("run", config, *quick)[1] == ""
    code, text = ssmpipe("run", config, "--set", "stages.fit.n_contro=9", *quick)
    assert (code, "did you mean 'n_control'" in text) == (2, True)
    (outlines / "egg3.csv").write_text("x,y\n1,2\nthree,4\n5,6\n")
    code, text = ssmpipe("run", config, *quick)
    assert code == 3
    assert "egg3.csv, line 3: 'three' is not a number" in text


def test_one_file_at_a_time(tmp_path: Path, outlines: Path) -> None:
    a, b, c = (tmp_path / name for name in ("a.csv", "b.csv", "c.npz"))
    landmarks = ("--landmarks", outlines / "landmarks.csv")
    assert ssmpipe("contour", outlines / "egg1.csv", a, *landmarks)[0] == 0
    code, text = ssmpipe("align", a, b, "--reference", outlines / "egg3.csv")
    assert code == 0, text
    assert json.loads((tmp_path / "b.csv.json").read_text())["landmarks"]["content"]["points"]["tip"]
    code, text = ssmpipe("fit", b, c, "--n-control", "30")
    assert code == 0, text
    assert read_spline(c).control_points.shape == (30, 2)
    code, text = ssmpipe("fit", b, c, "--tolerance-mm", "0.05")
    assert code == 0, text
    assert 30 != len(read_spline(c).control_points) < 80
    code, text = ssmpipe("align", a, b, "--reference", outlines / "egg3.csv", "--start-margin", "0.2")
    assert (code, "does not apply to this kind of file" in text) == (2, True)


def test_photographs_become_a_model(tmp_path: Path) -> None:
    folder = tmp_path / "hands"
    assert ssmpipe("synth", "hand-photographs", folder, "--n", "4") == (0, f"4 shapes written to {folder}\n")
    (folder / "scans/hand_01.pts").write_text("1 2\n3 4\n5 6\n")  # points of a picture are no scan of their own
    config = tmp_path / "hands.yaml"
    code, text = ssmpipe("init", "curve", folder / "scans", "-o", config)
    assert (code, text.splitlines()[0]) == (0, f"4 scans in {folder / 'scans'}; config written to {config}")
    assert "# landmarks" not in config.read_text(), "the landmarks beside the folder are found"
    code, text = ssmpipe("check", config)
    assert code == 0, text
    assert "4 of 4 scans can be used" in text
    quick = ["optimize.landmarks=[60]", "contour.ends=stem", "contour.longest_side=400", "fit.n_control=90"]
    quick = [part for text in quick for part in ("--set", f"stages.{text}")]
    code, text = ssmpipe("run", config, "-j", "1", "-q", *quick)
    assert code == 0, text
    with np.load(tmp_path / "out/hands/cohort/optimize/correspondence.npz") as found:
        assert str(found["topology"]) == "curve-open"
        for shape, points in zip(found["ids"], found["points_scan"], strict=True):
            truth = read_outline(folder / "outlines" / f"{shape}.csv")
            gaps = np.sqrt(((points[:, None] - truth.points) ** 2).sum(axis=-1)).min(axis=1)
            assert gaps.max() < 8.0, "in the pixels of the picture"
    code, text = ssmpipe("check", config, "--set", "input.units=mm")
    assert "a picture is measured in pixels; try: set input.units: none" in text.replace("\n", " ")
    (folder / "scans/hand_03.jpg").write_bytes(b"\xff\xd8\xff\xe0 cut off")
    code, text = ssmpipe("run", config, "-j", "1", "-q", *quick)
    assert code == 3
    assert "hand_03.jpg" in text
    assert "not a readable JPEG file" in text
    target = tmp_path / "one.csv"
    code, text = ssmpipe("contour", folder / "scans/hand_02.jpg", target, "--method", "silhouette", "--ends", "stem")
    assert code == 0, text
    assert "method: silhouette" in text
    assert not read_outline(target).closed
    assert not (tmp_path / "one.csv.npz").exists(), "the picture is not copied"


def test_spline_files_enter_at_optimize(tmp_path: Path) -> None:
    assert ssmpipe("synth", "line-bump", tmp_path / "lines") == (0, f"4 shapes written to {tmp_path / 'lines'}\n")
    group = "[{optimize: {n_coefficients: [8], landmarks: [31], normalize: none}}, model, evaluate, report]"
    inputs = "{scans: lines/scans/*.npz, landmarks: lines/landmarks.csv, units: none}"
    for name, head, stages in (
        ("group", "", group),
        ("preset", "anatomy: curve\n", group.replace(", model, evaluate, report", "")),
    ):
        config = tmp_path / f"{name}.yaml"
        config.write_text(f"name: {name}\ninput: {inputs}\noutput: {name}\n{head}stages: {stages}\n")
        assert ssmpipe("check", config)[0] == 0
        code, text = ssmpipe("run", config, "-j", "1", "-q")
        assert (code, text) == (0, "")
    first, second = (
        (tmp_path / name / "cohort/optimize/correspondence.npz").read_bytes() for name in ("group", "preset")
    )
    assert first == second
    assert not (tmp_path / "preset" / "shapes").exists()
    (tmp_path / "lines/scans/odd.npz").write_bytes((tmp_path / "lines/truth.npz").read_bytes())
    code, text = ssmpipe("run", tmp_path / "group.yaml", "-j", "1", "-q")
    assert code == 3
    assert "odd.npz" in text


@pytest.mark.slow
@pytest.mark.skipif(not MOUSE.is_dir(), reason="needs ../shared/data/mouse_vertebra")
def test_mouse_vertebrae_end_to_end(tmp_path: Path) -> None:
    config = Path(__file__).parents[2] / "configs" / "mouse_vertebra.yaml"
    sets = {
        "input.scans": f"{MOUSE}/contours/*.csv",
        "input.cohort": MOUSE / "cohort.csv",
        "input.landmarks": MOUSE / "landmarks.csv",
        "output": tmp_path / "out",
    }
    args = [part for key, value in sets.items() for part in ("--set", f"{key}={value}")]
    code, text = ssmpipe("run", config, "-q", *args)
    assert code == 0, text
    rows = (tmp_path / "out/cohort/evaluate/landmark_transfer.csv").read_text().splitlines()
    before, after = (float(r.split(",")[4]) for r in rows if r.startswith("all,"))
    assert before == pytest.approx(6.7, abs=0.3)
    assert after < 4.5
    header = (tmp_path / "out/cohort/model/scores.csv").read_text().splitlines()[1]
    assert header.endswith(",group")
