import csv
import html
import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

from ssmpipe.cli import main
from ssmpipe.io.meshes import read_mesh
from tests.support.groups_run import grouped_points, write_groups

HALVES = ["healthy"] * 8 + ["ill"] * 8
TWINS = [f"s{i % 8}" for i in range(16)]
HOSTILE = "</script><script>x"


def compare(*arguments: object) -> Result:
    return CliRunner().invoke(main, ["compare", *map(str, arguments), "--permutations", "199"])


def table(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(line for line in file if not line.startswith("#")))


@pytest.fixture
def result(tmp_path: Path) -> Path:
    columns = {
        "group": HALVES,
        "age": [str(40 + 3 * (i % 8)) for i in range(16)],
        "sex": ["m", "f"] * 8,
        "one": ["x"] * 16,
    }
    return write_groups(tmp_path / "run", grouped_points(), columns)


def test_everything_is_written_and_the_same_again(result: Path, tmp_path: Path) -> None:
    done = compare(result, "-o", tmp_path / "a")
    assert done.exit_code == 0, done.output
    assert "ill - healthy: modes together p = " in done.output
    assert "No column tells the subjects" in done.output
    names = {p.name for p in (tmp_path / "a").iterdir()}
    assert {"mean_healthy.ply", "mean_ill.ply", "difference.vtp", "compare.html", "compare.json", "scores.png"} <= names
    assert "discriminant_healthy_ill_minus3.0.ply" in names
    firsts = {"tests": "test", "modes": "mode", "pairs": "pair", "shapes": "id"}
    for name, first in firsts.items():
        assert next(iter(table(tmp_path / f"a/{name}.csv")[0])) == first
    points = grouped_points()
    assert np.allclose(read_mesh(tmp_path / "a/mean_ill.ply").vertices, points[8:].mean(axis=0), atol=1e-8)
    assert compare(result, "-o", tmp_path / "b").exit_code == 0
    for path in (tmp_path / "a").iterdir():
        assert path.read_bytes() == (tmp_path / "b" / path.name).read_bytes(), path.name


def test_the_bump_is_in_the_numbers(result: Path, tmp_path: Path) -> None:
    assert compare(result, "-o", tmp_path / "a").exit_code == 0
    said = json.loads((tmp_path / "a/compare.json").read_text())
    assert said["all_groups"]["p_anywhere"] == 0.005
    assert said["pairs"][0]["highest_distance_mm"] == pytest.approx(1.5, abs=0.5)
    assert said["correspondence"] == "one model"
    text = (tmp_path / "a/difference.vtp").read_text()
    for name in ("distance_mm", "p", "q", "p_family_wise", "p_t2", "cohen_d"):
        assert f'Name="{name}"' in text
    assert compare(result, "-o", tmp_path / "b", "--groups", "ill,healthy").exit_code == 0
    turned = json.loads((tmp_path / "b/compare.json").read_text())["pairs"][0]
    assert turned["pair"] == "healthy - ill"
    assert turned["lowest_distance_mm"] == pytest.approx(-said["pairs"][0]["highest_distance_mm"])
    assert turned["p"] == said["pairs"][0]["p"]


def test_repeated_measures_are_flagged_and_pairs_compared(tmp_path: Path) -> None:
    run = write_groups(tmp_path / "run", grouped_points(), {"group": HALVES, "subject": TWINS})
    done = compare(run, "-o", tmp_path / "a")
    assert "16 shapes of 8 subjects are not 16 independent samples" in done.output
    assert "8 subjects have shapes in both groups; --paired compares these" in done.output
    assert json.loads((tmp_path / "a/compare.json").read_text())["n_subjects"] == 8
    paired = compare(run, "-o", tmp_path / "b", "--paired", "subject")
    assert paired.exit_code == 0, paired.output
    row = table(tmp_path / "b/pairs.csv")[0]
    assert (row["n_subject_pairs"], row["n_rearrangements"]) == ("8", "256")


def test_groups_of_another_table(result: Path, tmp_path: Path) -> None:
    given = tmp_path / "other.csv"
    rows = [f"p{i:02d},{'ab'[i % 2]},s{i}" for i in range(14)]
    given.write_text("\n".join(["id,group,subject", *rows, "zz,a,s99"]) + "\n")
    done = compare(result, "-o", tmp_path / "a", "--cohort", given, "--covariates", "age")
    assert done.exit_code == 0, done.output
    assert "b - a: modes together" in done.output
    assert "1 row of the given table is no shape of the result (zz)" in done.output
    said = json.loads((tmp_path / "a/compare.json").read_text())
    assert said["left_out"] == ["p14", "p15"], "no row, no group, although the run knew one"
    assert said["cohort_table"]["file"] == "other.csv"
    assert [g["n_shapes"] for g in said["groups"]] == [7, 7]
    assert said["covariates"] == ["age"], "what the table does not have is as the run knew it"
    given.write_text("id,group\nq1,a\nq2,b\n")
    refused = compare(result, "-o", tmp_path / "b", "--cohort", given)
    assert refused.exit_code == 2
    assert "no shape of" in refused.output
    assert not (tmp_path / "b").exists()


def test_a_table_for_two_results(tmp_path: Path) -> None:
    points = grouped_points(n=24)
    a, b = (write_groups(tmp_path / name, part, {}) for name, part in (("healthy", points[:12]), ("ill", points[12:])))
    given = tmp_path / "ages.csv"
    given.write_text("id,age\n" + "".join(f"p{i:02d},{40 + i}\n" for i in range(12)))
    done = compare(a, b, "-o", tmp_path / "out", "--cohort", given, "--covariates", "age")
    assert done.exit_code == 0, done.output
    assert json.loads((tmp_path / "out/compare.json").read_text())["covariates"] == ["age"]


def test_few_rearrangements_are_said(tmp_path: Path) -> None:
    run = write_groups(tmp_path / "run", grouped_points(n=6), {"group": ["a"] * 3 + ["b"] * 3})
    done = compare(run, "-o", tmp_path / "a", "--alpha", "0.01")
    assert "only 20 different rearrangements, so that no p value can be below 0.05" in done.output
    assert "Small sample: with 3 and 3 subjects" in done.output


def test_covariates(result: Path, tmp_path: Path) -> None:
    done = compare(result, "-o", tmp_path / "a", "--covariates", "age,sex,size")
    assert done.exit_code == 0, done.output
    assert json.loads((tmp_path / "a/compare.json").read_text())["covariates"] == ["age", "sex = m", "log size"]


def test_three_groups(tmp_path: Path) -> None:
    run = write_groups(tmp_path / "run", grouped_points(), {"kind": ["a"] * 5 + ["b"] * 5 + ["c"] * 6})
    assert compare(run, "--by", "kind", "-o", tmp_path / "a").exit_code == 0
    assert [row["pair"] for row in table(tmp_path / "a/pairs.csv")] == ["b - a", "c - a", "c - b"]
    assert 'Name="distance_mm_c_minus_a"' in (tmp_path / "a/difference.vtp").read_text()


def test_planar_curves(tmp_path: Path) -> None:
    t = 2 * np.pi * np.arange(24) / 24
    circle = np.stack([np.cos(t), np.sin(t)], axis=1)
    radius = 1 + 0.02 * np.random.default_rng(0).normal(size=16) + 0.2 * (np.arange(16) >= 8)
    points = circle * radius[:, None, None] + 0.01 * np.random.default_rng(1).normal(size=(16, 24, 2))
    run = write_groups(tmp_path / "run", points, {"group": HALVES}, "curve-closed")
    (run / "run.json").write_text(json.dumps({"config": {"input": {"units": "none"}}}))
    done = compare(run, "-o", tmp_path / "a")
    assert done.exit_code == 0, done.output
    rows = table(tmp_path / "a/difference.csv")
    assert np.allclose([float(row["distance_mm"]) for row in rows], 0.2, atol=0.06)
    assert (tmp_path / "a/mean_ill.csv").is_file()
    assert "file units" in (tmp_path / "a/compare.html").read_text(encoding="utf-8")


def test_two_results_are_matched_and_it_is_said(tmp_path: Path) -> None:
    points = grouped_points(n=24)
    a = write_groups(tmp_path / "healthy", points[:12], {"subject": [f"a{i}" for i in range(12)]})
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    b = write_groups(tmp_path / "ill", points[12:] @ turn.T + [30, 0, 5], {"subject": [f"b{i}" for i in range(12)]})
    done = compare(a, b, "-o", tmp_path / "out")
    assert done.exit_code == 0, done.output
    assert "Two results were matched after the fact" in done.output
    said = json.loads((tmp_path / "out/compare.json").read_text())
    assert said["correspondence"]["matched"] == "closest points of the means"
    assert said["pairs"][0]["pair"] == "ill - healthy"
    assert said["pairs"][0]["highest_distance_mm"] == pytest.approx(1.5, abs=0.6)
    assert said["pairs"][0]["p_anywhere"] <= 0.05
    assert {row["id"] for row in table(tmp_path / "out/shapes.csv")} >= {"healthy/p00", "ill/p00"}


def test_the_page_asks_nothing_of_the_network_and_escapes_names(tmp_path: Path) -> None:
    run = write_groups(tmp_path / "run", grouped_points(), {"group": ["a"] * 8 + [HOSTILE] * 8})
    assert compare(run, "-o", tmp_path / "a", "--groups", f"a,{HOSTILE}").exit_code == 0
    page = (tmp_path / "a/compare.html").read_text(encoding="utf-8")
    assert "default-src 'none'; script-src 'sha256-" in html.unescape(page)
    assert HOSTILE not in page
    assert "http://" not in page.split("<script>")[0].replace("http://www.w3.org", "")
    assert (tmp_path / "a/mean_script_script_x.ply").is_file()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--by", "kind"], "there is no column 'kind' for --by; there are group, age, sex, one"),
        (["--by", "kind"], "or add the column to the cohort table and `ssmpipe run` again"),
        (["--by", "one"], "column 'one' has 1 value"),
        (["--groups", "healthy,sick"], "no shape has 'sick' in column 'group'; there are healthy, ill"),
        (["--groups", "ill"], "--groups names ill only, at least two groups are needed"),
        (["--by", "age", "--groups", "40,43,40"], "--groups names a group twice"),
        (["--covariates", "weight"], "there is no column 'weight' for --covariates"),
        (["--subject", "patient"], "there is no column 'patient' for --subject"),
        (["--paired", "patient"], "there is no column 'patient' for --paired; there are group"),
        (["--modes", "15"], "15 modes cannot be tested jointly, these shapes allow 1 to 7"),
        (["--modes", "few"], "'few' is neither auto nor a number of modes"),
        (["--paired", "one", "--subject", "age"], "name different columns"),
        (["--paired", "one"], "1 subjects have shapes in both groups, a paired comparison needs at least 3"),
    ],
)
def test_what_does_not_fit_is_refused(arguments: list[str], words: str, result: Path, tmp_path: Path) -> None:
    done = compare(result, "-o", tmp_path / "a", *arguments)
    assert done.exit_code == 2, done.output
    assert words in done.output
    assert not (tmp_path / "a").exists()


def test_results_of_different_kinds_are_refused(result: Path, tmp_path: Path) -> None:
    other = write_groups(tmp_path / "disks", grouped_points("disk"), {}, "disk")
    done = compare(result, other, "-o", tmp_path / "a")
    assert done.exit_code == 2
    assert "the two results differ in their topology: tube and disk; try: put all scans into one config" in done.output
    assert "--by splits one result" in compare(result, result, "--by", "group", "-o", tmp_path / "a").output
