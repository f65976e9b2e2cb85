from __future__ import annotations

import numpy as np
import pytest

from ssmpipe.contract import Table
from ssmpipe.report.pseudonyms import WITHHELD, Pseudonyms, assign, make_pseudonyms
from tests.support.small_run import small_run

IDS = ("Smith_John", "Smith_John_2", "doe.jane", "ZZ-77-1961")


def names() -> tuple[Pseudonyms, dict]:
    record = small_run(ids=IDS, n=7).record
    for k, shape in enumerate(record["shapes"].values()):
        shape["info"] = {
            "side": "L", "subject": f"Hans Meier {k}", "age": str(50 + k), "born": f"1961-0{k + 1}-01", "mrn": str(4711000 + 17 * k),
            "scanner": "GE" if k % 2 else "Siemens", "path": f"/data/{k}.stl",
        }  # fmt: skip
    record["config"]["input"]["scans"] = "../raw data of Smith/*.ply"
    record["config"]["stages"] += [{"align": {"reference": "Smith_John_2"}}]
    record["cohort_stages"][0]["warnings"] = [
        "Smith_John: 3 holes, see /home/meier/out.ply",
        "Smith_John_2 and doe.jane differ by 2.5 mm",
    ]
    record["cohort_stages"][0]["metrics"]["worst"] = "doe.jane"
    return make_pseudonyms(record, {}, {}), record


def test_nothing_original_is_left_in_the_record() -> None:
    made, record = names()
    text = repr(made.record(record))
    for secret in (*IDS, "Hans", "Meier", "1961-0", "4711", "raw data", "/home", "/data", ".stl", ".ply"):
        assert secret not in text, secret
    for kept in (
        "'age': '52'",
        "Siemens",
        "S002",
        "differ by 2.5 mm",
        "P001 and P003" if made.names["Smith_John_2"] == "P001" else "differ",
    ):
        assert kept in text, kept
    hidden = made.record(record)
    assert sorted(hidden["shapes"]) == sorted(made.names[i] for i in record["shapes"])
    assert hidden["config"]["input"]["scans"] == WITHHELD
    assert hidden["config"]["stages"][-1]["align"]["reference"] == made.names["Smith_John_2"]
    assert hidden["cohort_stages"][0]["metrics"]["worst"] == made.names["doe.jane"]
    assert list(hidden["failures"]) == [made.names["P99_broken"]]


def test_longer_names_are_not_cut_by_shorter_ones() -> None:
    made, _ = names()
    assert (
        made.text("Smith_John_2, Smith_John and Smith_Johnny")
        == f"{made.names['Smith_John_2']}, {made.names['Smith_John']} and Smith_Johnny"
    )
    assert Pseudonyms({"7": "P001", "a": "P002"}, {}).text("a hole of 7 mm") == "a hole of 7 mm"


def test_names_once_given_stay() -> None:
    first = assign(["c", "b"])
    assert assign(["a", "b", "c"], first) == {"b": "P001", "c": "P002", "a": "P003"}
    assert assign(["c"], first) == first  # a shape that is away for a while keeps its name


def test_results_carry_the_names_and_the_same_numbers() -> None:
    made, _ = names()
    run = small_run(ids=IDS, n=7)
    given = {
        "correspondence": run.correspondence, "model": run.model, "quality": run.quality, "certificate": run.certificate,
        "measures": run.measures, "reconstructions": {"ids": np.array(IDS), "points": run.correspondence.points}, "landmark_transfer": None,
    }  # fmt: skip
    hidden = made.results(given)
    expected = tuple(made.names[i] for i in IDS)
    assert hidden["model"].ids == hidden["correspondence"].ids == tuple(hidden["reconstructions"]["ids"]) == expected
    assert hidden["model"].scores is run.model.scores
    assert hidden["quality"].columns["id"] == [made.names[i] for i in run.quality.columns["id"]]
    assert hidden["measures"] is run.measures
    assert hidden["certificate"]["shapes"][expected[2]] == run.certificate["shapes"][IDS[2]]


@pytest.mark.parametrize(
    ("column", "kept"),
    [
        (["61", "72", "58"], True),
        (["61", "", "58"], True),
        (["a", "b", "a"], True),
        (["a", "b", "c"], False),
        (["1000231", "1000232", "1000250"], False),
        (["2001-02-03", "2001-02-04", "2001-02-05"], False),
        (["x/y.stl", "x/y.stl", ""], False),
    ],
)
def test_only_numbers_and_groups_of_the_cohort_table_are_given_away(column: list[str], kept: bool) -> None:
    shapes = {f"id_{k}": {"info": {"side": "L", "extra": value}, "stages": []} for k, value in enumerate(column)}
    made = make_pseudonyms({"shapes": shapes}, {}, {}).record({"shapes": shapes})
    assert any("extra" in shape["info"] for shape in made["shapes"].values()) == kept


def test_a_table_without_ids_is_left_alone() -> None:
    table = Table({"landmark": ["a"]})
    assert names()[0].table(table) is table
