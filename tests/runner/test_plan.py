"""Plans on small named graphs."""

from __future__ import annotations

from typing import Any, Literal

import pytest

from ssmpipe.contract import Port, Stage, StageConfig
from ssmpipe.core.errors import ConfigError
from ssmpipe.runner.plan import SCAN, Producer, Step, make_plan, segments, select

SCANS = {"mesh": "trimesh", "info": "info"}


def stage(
    name: str,
    reads: str,
    writes: str,
    scope: Literal["shape", "cohort"] = "shape",
    prepared: str = "",
) -> Step:
    def ports(text: str) -> tuple[Port, ...]:
        return tuple(
            Port(slot.strip("?"), {"mesh": "trimesh"}.get(slot.strip("?"), slot.strip("?")), slot.endswith("?"))
            for slot in text.split()
        )

    def run(**_: Any) -> dict[str, Any]:
        return {}

    inputs = ports(f"{reads} {prepared}")
    made = Stage(name, scope, 1, StageConfig, run, inputs, ports(writes), prepared=ports(prepared))
    return Step(name, made)


def ins(plan: Any, step: str) -> dict[str, str | None]:
    return {slot: p.step if p else None for slot, p in plan.step(step).inputs.items()}


def test_chain_reads_the_newest_producer() -> None:
    plan = make_plan(
        [stage("one", "mesh", "mesh"), stage("two", "mesh info", "uv"), stage("three", "mesh uv", "mesh")], SCANS
    )
    assert ins(plan, "one") == {"mesh": SCAN}
    assert ins(plan, "two") == {"mesh": "one", "info": SCAN}
    assert ins(plan, "three") == {"mesh": "one", "uv": "two"}
    assert [s.folder for s in plan.steps] == ["01-one", "02-two", "03-three"]


def test_a_stage_may_occur_twice() -> None:
    again = Step("one-2", stage("one", "mesh", "mesh").stage)
    plan = make_plan([stage("one", "mesh", "mesh"), again], SCANS)
    assert ins(plan, "one-2") == {"mesh": "one"}
    assert plan.steps[1].folder == "02-one-2"


def test_diamond_joins_in_the_cohort() -> None:
    plan = make_plan(
        [
            stage("left", "mesh", "uv"),
            stage("right", "mesh", "samples"),
            stage("join", "uv samples", "model", "cohort"),
        ],
        SCANS,
    )
    assert plan.step("join").inputs["uv"] == Producer("left", "shape")
    assert [kind for kind, _ in segments(plan.steps)] == ["shape", "cohort"]
    assert plan.tasks(["a", "b"]) == [("left", "a"), ("right", "a"), ("left", "b"), ("right", "b"), ("join", "")]


def test_preparation_is_a_barrier() -> None:
    plan = make_plan(
        [
            stage("one", "mesh", "mesh"),
            stage("align", "mesh", "mesh", prepared="reference"),
            stage("two", "mesh", "mesh"),
        ],
        SCANS,
    )
    assert plan.step("align").inputs["reference"] == Producer("align", "cohort", prepared=True)
    parts = [(kind, [s.id for s in steps]) for kind, steps in segments(plan.steps)]
    assert parts == [("shape", ["one"]), ("prepare", ["align"]), ("shape", ["align", "two"])]


def test_a_file_takes_the_place_of_a_preparation() -> None:
    step = stage("align", "mesh", "mesh", prepared="reference")
    step = Step("align", step.stage, files={"reference": ("sha", "/x.ply")})
    plan = make_plan([stage("one", "mesh", "mesh"), step], SCANS)
    assert [kind for kind, _ in segments(plan.steps)] == ["shape"]


def test_explicit_source() -> None:
    step = stage("three", "mesh", "uv")
    plan = make_plan(
        [
            stage("one", "mesh", "mesh"),
            stage("two", "mesh", "mesh"),
            Step("three", step.stage, sources={"mesh": "one"}),
        ],
        SCANS,
    )
    assert ins(plan, "three") == {"mesh": "one"}
    with pytest.raises(ConfigError, match="to read 'mesh' from 'later', which does not make it before"):
        make_plan([Step("three", step.stage, sources={"mesh": "later"}), stage("later", "mesh", "mesh")], SCANS)


def test_optional_inputs_may_be_absent() -> None:
    assert ins(make_plan([stage("one", "mesh uv?", "mesh")], SCANS), "one") == {"mesh": SCAN, "uv": None}


def test_missing_producer_names_who_comes_later() -> None:
    with pytest.raises(
        ConfigError, match="'two' needs 'uv', and no stage before it makes that; 'one' makes it, but comes later"
    ):
        make_plan([stage("two", "uv", "mesh"), stage("one", "mesh", "uv")], SCANS)


def test_kinds_must_agree() -> None:
    with pytest.raises(ConfigError, match="reads 'mesh' as trimesh, but 'scan' makes it as surface"):
        make_plan([stage("one", "mesh", "mesh")], {"mesh": "surface"})


def test_selection() -> None:
    plan = make_plan(
        [stage("one", "mesh", "mesh"), stage("two", "mesh", "mesh"), stage("three", "mesh", "mesh")], SCANS
    )
    assert [s.id for s in select(plan, first="two")] == ["two", "three"]
    assert [s.id for s in select(plan, last="two")] == ["one", "two"]
    assert [s.id for s in select(plan, only=["three", "one"])] == ["one", "three"]


def test_what_a_stage_prepared_can_be_read_later_from_the_same_file() -> None:
    first = stage("one", "mesh", "mesh", prepared="common")
    first = Step("one", first.stage, files={"common": ("digest", "/file.ply")})
    plan = make_plan([first, stage("two", "mesh common?", "uv")], SCANS)
    producer = plan.step("two").inputs["common"]
    assert producer == Producer("one", "cohort", prepared=True)
    assert plan.step("two").files == {"common": ("digest", "/file.ply")}
    assert not plan.step("two").prepares
    alone = make_plan([stage("two", "mesh common?", "uv")], SCANS)
    assert alone.step("two").inputs["common"] is None
