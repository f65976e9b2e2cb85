from __future__ import annotations

import csv
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ssmpipe.core.model.shape_model import Chain
from ssmpipe.io.arrays import read_npz, write_npz
from ssmpipe.io.models import read_model, write_model
from tests.support.eggs import model_of_eggs, ssmpipe, write_eggs


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return model_of_eggs(tmp_path_factory.mktemp("eggs"))


@pytest.fixture(scope="module")
def strangers(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_eggs(tmp_path_factory.mktemp("strangers"), range(20, 23))


@pytest.fixture(scope="module")
def projected_text(result: Path, strangers: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Two strangers, a shape of the cohort, and a file that is none."""
    scans = tmp_path_factory.mktemp("scans")
    for path in (strangers / "egg20.csv", strangers / "egg21.csv", result.parents[1] / "eggs" / "egg3.csv"):
        shutil.copy(path, scans)
    (scans / "broken.csv").write_text("x,y\n1,2\n1,2\n")
    out = tmp_path_factory.mktemp("projected")
    code, text = ssmpipe("project", result, *sorted(scans.glob("*.csv")), "-o", out)
    assert code == 3, text
    assert "3 projected, 1 failed" in text
    return out, text


@pytest.fixture(scope="module")
def projected(projected_text: tuple[Path, str]) -> Path:
    return projected_text[0]


def test_lengths_have_the_unit_of_the_config(projected_text: tuple[Path, str]) -> None:
    out, text = projected_text
    line = next(line for line in text.splitlines() if "egg20: Mahalanobis" in line)
    assert " file units" in line
    assert " mm" not in line
    assert "names end in _mm are in file units" in (out / "scores.csv").read_text().splitlines()[0]


def rows(folder: Path) -> dict[str, dict[str, str]]:
    lines = [line for line in (folder / "scores.csv").read_text().splitlines() if not line.startswith("#")]
    return {row["id"]: row for row in csv.DictReader(lines)}


def test_the_model_carries_its_chain(result: Path) -> None:
    model = read_model(result / "cohort/model/model.npz")
    assert model.chain is not None
    content = json.loads(model.chain.text)
    assert [step["id"] for step in content["steps"]] == ["contour", "align", "fit", "optimize"]
    assert content["units"] == "none"
    assert list(model.chain.prepared) == ["align.reference"]
    assert str(result.parents[1]) not in model.chain.text, "no folder of the machine in it"
    assert model.lambda_cut > 0


def test_a_failure_is_isolated_and_named(projected: Path) -> None:
    failures = json.loads((projected / "failures.json").read_text())
    assert list(failures) == ["broken"]
    assert failures["broken"]["stage"] == "contour"
    assert failures["broken"]["file"] == "broken.csv"
    assert set(rows(projected)) == {"egg20", "egg21", "egg3"}


def test_a_training_shape_returns_nearly_its_scores(result: Path, projected: Path) -> None:
    model = read_model(result / "cohort/model/model.npz")
    known = model.scores[model.ids.index("egg3")]
    found = np.array([float(rows(projected)["egg3"][f"mode_{m + 1:02d}"]) for m in range(len(known))])
    off = np.sqrt((model.variances * (found - known) ** 2).sum() / model.variances.sum())
    assert off < 0.03, "in mm, by the variation of the cohort; the last modes of the eggs are noise"
    assert np.abs(found - known)[:2].max() < 0.05


def test_another_scan_does_not_change_the_result(
    result: Path, strangers: Path, projected: Path, tmp_path: Path
) -> None:
    code, text = ssmpipe("project", result, strangers / "egg20.csv", "-o", tmp_path / "alone")
    assert code == 0, text
    for name in ("projection.npz", "projection.json", "corresponded.csv", "reconstruction.csv"):
        alone, together = (folder / "patients/egg20" / name for folder in (tmp_path / "alone", projected))
        assert alone.read_bytes() == together.read_bytes(), name


def test_curves_join_a_model_with_tangents_by_their_own(strangers: Path, tmp_path: Path) -> None:
    """Shapes of the cohort come back nearer than to the same model without its tangents, and a stranger joins."""
    result = model_of_eggs(tmp_path, normals=0.5, normalize="affine")
    model = read_model(result / "cohort/model/model.npz")
    assert model.normals is not None
    assert model.normals.shape == model.training_points.shape
    np.testing.assert_allclose(np.linalg.norm(model.normals, axis=2), 1.0, atol=0.02)
    along = np.roll(model.training_points, -1, axis=1) - np.roll(model.training_points, 1, axis=1)
    along /= np.linalg.norm(along, axis=2, keepdims=True)
    assert (model.normals * along).sum(axis=2).min() > 0.98
    write_model(tmp_path / "blind.npz", replace(model, normals=None, normal_scale=0.0))
    known = ("egg1", "egg2", "egg4", "egg5")
    scans = [*(tmp_path / f"eggs/{i}.csv" for i in known), strangers / "egg20.csv"]
    off = []
    for name, at in (("seeing", result), ("blind", tmp_path / "blind.npz")):
        code, text = ssmpipe("project", at, *scans, "-o", tmp_path / name)
        assert code == 0, text
        assert {row["certificate"] for row in rows(tmp_path / name).values()} == {"proved"}
        found = np.stack([read_npz(tmp_path / name / f"patients/{i}/projection.npz")["points"] for i in known])
        off.append(rms(found - model.training_points[[model.ids.index(i) for i in known]]))
    assert off[0] < 0.8 * off[1]
    assert off[0] < 0.002 * rms(model.mean - model.mean.mean(axis=0))
    new = [read_npz(tmp_path / name / "patients/egg20/projection.npz")["points"] for name in ("seeing", "blind")]
    assert 0 < rms(new[0] - new[1]) < 1.0


def rms(offsets: np.ndarray) -> float:
    return float(np.sqrt((offsets**2).sum(axis=-1).mean()))


def test_numbers_and_files_agree(result: Path, projected: Path) -> None:
    model = read_model(result / "cohort/model/model.npz")
    row = rows(projected)["egg20"]
    found = read_npz(projected / "patients/egg20/projection.npz")
    scores = found["scores"]
    assert float(row["mahalanobis"]) == pytest.approx(np.linalg.norm(scores))
    np.testing.assert_allclose(found["reconstruction"], model.instance(scores), atol=1e-9)
    np.testing.assert_allclose(
        found["points_scan"] @ found["transform"][:2, :2].T + found["transform"][:2, 3], found["points"], atol=1e-9
    )
    assert row["certificate"] == "proved"
    assert 0 < float(row["mode_01_sd"]) < 0.5
    assert 0 < float(row["mahalanobis_p"]) <= 1
    assert float(row["to_scan_mean_mm"]) <= float(row["to_scan_p95_mm"]) <= float(row["to_scan_max_mm"])


def test_corresponded_points_lie_on_the_scan(strangers: Path, projected: Path) -> None:
    from ssmpipe.core.outline.distance import point_to_segments
    from ssmpipe.io.outlines import read_outline

    scan = read_outline(strangers / "egg20.csv")
    places = read_npz(projected / "patients/egg20/projection.npz")["points_scan"]
    assert point_to_segments(places, scan.points, scan.edges)[0].max() < 0.2


def test_every_patient_has_a_page(projected: Path) -> None:
    pages = ["egg20.html", "egg21.html", "egg3.html", "index.html"]
    assert sorted(path.name for path in projected.glob("*.html")) == pages
    html = (projected / "egg20.html").read_text()
    assert f"{float(rows(projected)['egg20']['mahalanobis']):.3g}" in html
    assert "file units" in html


def test_a_list_leads_to_every_patient(projected: Path) -> None:
    html = (projected / "index.html").read_text()
    told = rows(projected)
    order = sorted(told, key=lambda i: -float(told[i]["mahalanobis"]))
    assert re.findall(r'<th scope="row"><a href="([^"]*)">', html) == [f"{i}.html" for i in order]
    for row in told.values():
        assert f"<td>{float(row['residual_rms_mm']):.3g}" in html
    assert "3 of 4" in html
    assert re.search(r"<strong>broken</strong> \(broken.csv\) stopped at <em>contour</em>", html)
    assert "[file units]" in html
    assert 'href="index.html"' in (projected / "egg3.html").read_text()


def test_a_patient_cannot_be_called_like_the_list(result: Path, strangers: Path, tmp_path: Path) -> None:
    shutil.copy(strangers / "egg20.csv", tmp_path / "index.csv")
    code, text = ssmpipe("project", result, tmp_path / "index.csv", "-o", tmp_path / "out")
    assert code == 2
    assert "'index' cannot be the id of a patient" in text
    assert not (tmp_path / "out").exists()


def test_stages_give_advice_for_a_new_patient(result: Path, strangers: Path, tmp_path: Path) -> None:
    model = read_model(result / "cohort/model/model.npz")
    assert model.chain is not None
    text = model.chain.text.replace('"chirality":"keep"', '"chirality":"best-fit"')
    assert text != model.chain.text
    write_model(tmp_path / "model.npz", replace(model, chain=Chain(text, model.chain.prepared)))
    _, said = ssmpipe("project", tmp_path / "model.npz", strangers / "egg20.csv", "-o", tmp_path / "out")
    assert "left and right fit almost alike" in said, "an egg has no side"
    assert "look at its page" in said
    again = (tmp_path / "out/index.html").read_text()
    assert re.search(r"<strong>egg20</strong>, align: left and right fit almost alike", again)
    ssmpipe("project", tmp_path / "model.npz", strangers / "egg20.csv", "-o", tmp_path / "out")
    assert (tmp_path / "out/index.html").read_text() == again, "stages that are up to date warn as before"


def test_what_cannot_be_projected_is_refused_before_any_work(result: Path, strangers: Path, tmp_path: Path) -> None:
    code, text = ssmpipe("project", result, tmp_path / "none.csv", "-o", tmp_path / "out")
    assert (code, "does not exist; try: check the path" in text) == (2, True)
    (tmp_path / "a.ply").write_text("ply")
    code, text = ssmpipe("project", result, tmp_path / "a.ply", "-o", tmp_path / "out")
    assert code == 2
    assert "the model was built from outline files, a.ply is of the kind mesh" in text
    arrays = read_npz(result / "cohort/model/model.npz")
    write_npz(tmp_path / "model.npz", {**arrays, "chain": np.array("")})
    code, text = ssmpipe("project", tmp_path / "model.npz", strangers / "egg20.csv", "-o", tmp_path / "out")
    assert code == 2
    assert "model.npz does not carry the chain" in text
    assert not (tmp_path / "out").exists()


def test_a_changed_stage_is_told(result: Path, strangers: Path, tmp_path: Path) -> None:
    arrays = read_npz(result / "cohort/model/model.npz")
    content = json.loads(str(arrays["chain"]))
    content["steps"][1]["version"] = 0
    write_npz(tmp_path / "model.npz", {**arrays, "chain": np.array(json.dumps(content))})
    code, text = ssmpipe("project", tmp_path / "model.npz", strangers / "egg22.csv", "-o", tmp_path / "out")
    assert code == 0, text
    assert "stage 'align' is version" in text
    content["steps"][1]["options"]["nonsense"] = 1
    write_npz(tmp_path / "model.npz", {**arrays, "chain": np.array(json.dumps(content))})
    code, text = ssmpipe("project", tmp_path / "model.npz", strangers / "egg22.csv", "-o", tmp_path / "out")
    assert code == 2
    assert "does not accept its options any more" in text


def test_a_chain_that_leads_out_of_the_folder_is_refused(result: Path, strangers: Path, tmp_path: Path) -> None:
    arrays = read_npz(result / "cohort/model/model.npz")
    content = json.loads(str(arrays["chain"]))
    content["steps"][1]["id"] = "../../align"
    renamed = {name.replace("prepared/align.", "prepared/../../align."): value for name, value in arrays.items()}
    write_npz(tmp_path / "model.npz", {**renamed, "chain": np.array(json.dumps(content))})
    code, text = ssmpipe("project", tmp_path / "model.npz", strangers / "egg22.csv", "-o", tmp_path / "a/out")
    assert code == 3
    assert "its chain is not readable (a step)" in text
    assert sorted(path.name for path in tmp_path.iterdir()) == ["model.npz"]
