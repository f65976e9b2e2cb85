"""Whole runs with toy stages, in real child processes."""

from __future__ import annotations

import json
import os
import shutil
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ssmpipe.runner.batch as batch
import ssmpipe.runner.execute as execute
from ssmpipe.core.errors import ConfigError, LandmarkError, SsmpipeError
from ssmpipe.io.meshes import read_mesh, write_mesh
from ssmpipe.runner.batch import Job, run_job
from ssmpipe.runner.console import Console
from ssmpipe.runner.disk import DiskError
from ssmpipe.runner.execute import run_task
from ssmpipe.runner.lock import LockHeldError, locked
from ssmpipe.runner.manifest import read_manifest
from ssmpipe.runner.patience import ClusterLostError
from ssmpipe.runner.project import Project
from ssmpipe.runner.run import RunResult, run_project
from ssmpipe.runner.run_options import RunOptions
from ssmpipe.runner.sources import check_landmarks
from ssmpipe.runner.status import print_status, status_of
from ssmpipe.runner.workspace import make_workspace
from tests.support.toys import TOY, reasons, tetrahedron

Load = Callable[..., Project]
Run = Callable[..., RunResult]


def tree(out: Path) -> dict[str, bytes]:
    """Return everything that must not differ between runs."""
    skip = ("timing.json", "run.json", "history.csv", ".lock", ".lock.json", ".failures.lock")
    return {
        str(p.relative_to(out)): p.read_bytes()
        for p in sorted(out.rglob("*"))
        if p.is_file() and p.name not in skip and ".work" not in p.parts
    }


def entries(out: Path) -> dict[tuple[str, str], dict[str, Any]]:
    record = json.loads((out / "run.json").read_text())
    found = {(t["step"], i): t for i, shape in record["shapes"].items() for t in shape["stages"]}
    return found | {(t["step"], ""): t for t in record["cohort_stages"]}


def test_a_run_and_its_record(run: Run, tmp_path: Path) -> None:
    result = run("stages.shift.noise=1.5")
    out = tmp_path / "out"
    assert (result.exit_code, result.ok, result.n_run) == (0, ["a", "b", "c", "d"], 9)
    assert sorted(p.name for p in (out / "shapes" / "a").iterdir()) == ["01-grow", "02-shift"]
    assert sorted(p.name for p in (out / "cohort").iterdir()) == ["02-shift-prepare", "total"]
    assert sorted(p.name for p in (out / "shapes" / "a" / "01-grow").iterdir()) == [
        "log.txt",
        "manifest.json",
        "mesh.ply",
        "timing.json",
    ]
    assert not (out / "failures.json").exists()
    assert not (out / ".work").exists()
    record = json.loads((out / "run.json").read_text())
    assert set(record["versions"]) == {"python", "numpy", "scipy", "libigl", "trimesh"}
    assert "cohort/total/history.csv" in record["volatile"]
    assert record["methods"][0]["sentence"] == "Meshes were scaled by 2."
    task = entries(out)["shift", "b"]
    assert (task["status"], task["reason"], len(task["fingerprint"])) == ("done", "first run", 64)
    assert task["warnings"] == ["that is a lot of noise; lower shift.noise"]
    assert set(task["timing"]) >= {"start", "seconds", "peak_rss_mb"}


def test_manifests_hold_no_clock_and_no_path(run: Run, tmp_path: Path) -> None:
    run()
    text = (tmp_path / "out/shapes/a/01-grow/manifest.json").read_text()
    assert str(tmp_path) not in text
    assert "elapsed_s" not in text
    assert "elapsed_s" in (tmp_path / "out/shapes/a/01-grow/timing.json").read_text()


def test_second_run_does_nothing(run: Run, tmp_path: Path) -> None:
    run()
    before = {p: p.stat().st_mtime_ns for p in tmp_path.glob("out/*/*/*/*")}
    result = run()
    assert (result.n_run, result.n_current, result.exit_code) == (0, 9, 0)
    assert before == {p: p.stat().st_mtime_ns for p in tmp_path.glob("out/*/*/*/*")}
    assert {t["reason"] for t in entries(tmp_path / "out").values()} == {"up to date"}


def test_one_option_reruns_only_what_depends_on_it(run: Run, project: Load, tmp_path: Path) -> None:
    run()
    result = run("stages.total.weight=2")
    assert (result.n_run, result.n_current) == (1, 8)
    assert entries(tmp_path / "out")["total", ""]["reason"] == "config changed: weight"
    result = run("stages.shift.noise=0.1", "stages.total.weight=2")
    assert (result.n_run, result.n_current) == (5, 4)
    assert entries(tmp_path / "out")["total", ""]["reason"] == "input changed: mesh"


def test_same_output_spares_what_comes_after(run: Run, project: Load, tmp_path: Path) -> None:
    run()
    assert reasons(project("stages.grow.note=x"))["total", ""].startswith("input may change: mesh")
    result = run("stages.grow.note=x")
    assert (result.n_run, result.n_current) == (4, 5)
    assert {i for (step, i), t in entries(tmp_path / "out").items() if t["status"] == "done"} == {"a", "b", "c", "d"}


def test_version_change_reruns(run: Run, project: Load) -> None:
    run()
    one = project()
    from dataclasses import replace

    steps = tuple(replace(s, version=2) if s.id == "grow" else s for s in one.plan.steps)
    changed = replace(one, plan=replace(one.plan, steps=steps))
    assert reasons(changed)["grow", "a"] == "stage version changed: 1 -> 2"


def test_jobs_do_not_change_a_bit(run: Run, tmp_path: Path) -> None:
    run("stages.shift.noise=0.5", options=RunOptions(jobs=1))
    one = tree(tmp_path / "out")
    shutil.rmtree(tmp_path / "out")
    run("stages.shift.noise=0.5", options=RunOptions(jobs=2))
    assert tree(tmp_path / "out") == one
    assert len(one) > 20


# --- failures ---


def test_bad_shapes_are_named_and_the_others_go_on(
    run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    result = run(
        "stages.grow.refuse=[a]",
        "min_shapes=2",
        stages=[{"grow": {"abort": ["c"]}}, "shift", "total"],
        max_failed_fraction=0.5,
    )
    assert result.exit_code == 3
    assert result.ok == ["b", "d"]
    failures = json.loads((tmp_path / "out/failures.json").read_text())
    assert failures == {
        "a": {"stage": "grow", "file": "a.ply", "error": "the mesh has 2 components", "remedy": "keep the largest"},
        "c": {
            "stage": "grow",
            "file": "c.ply",
            "error": "the process crashed (SIGABRT)",
            "remedy": "check the scan in a mesh viewer",
        },
    }
    assert read_manifest(tmp_path / "out/cohort/total").metrics == {"n_shapes": 2}  # type: ignore[union-attr]
    lines = capsys.readouterr().err.splitlines()
    assert "failed: a, grow, a.ply: the mesh has 2 components; try: keep the largest" in lines
    assert "Traceback" in (tmp_path / "out/shapes/a/failed.txt").read_text()
    again = run(stages=["grow", "shift", "total"])
    assert again.exit_code == 0
    assert not (tmp_path / "out/failures.json").exists()
    assert not (tmp_path / "out/shapes/a/failed.txt").exists()


@pytest.mark.parametrize(
    ("way", "text"),
    [("leave", "a library ended the process (exit code 1)"), ("bug", "internal error ZeroDivisionError: oops")],
)
def test_other_ways_to_fail(run: Run, way: str, text: str) -> None:
    result = run(f"stages.grow.{way}=[b]", options=RunOptions(jobs=2))
    assert result.exit_code == 3
    assert result.failures["b"].error == text
    assert result.failures["b"].stage == "grow"
    assert result.ok == ["a", "c", "d"]


def test_a_shape_that_hangs_is_ended(run: Run) -> None:
    # the others are done before: however slow the machine, a limit ends only who hangs
    run("stages.grow.refuse=[b]", options=RunOptions(jobs=2))
    result = run(
        "stages.grow.hang=[b]", "limits.timeout_s=0.5", options=RunOptions(jobs=2, only=("grow",), shapes=("b",))
    )
    assert result.exit_code == 3
    assert result.failures["b"].error == "did not finish within 0.5 s"
    assert result.failures["b"].stage == "grow"


def test_a_limit_that_the_system_refuses_is_said_once(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    resource = pytest.importorskip("resource", reason="Windows has no limit to refuse")
    before = resource.getrlimit(resource.RLIMIT_AS)
    said = []
    monkeypatch.setattr(Console, "warn", lambda self, text: said.append(text))
    result = run(f"limits.memory_mb={2**45}", options=RunOptions(jobs=2))
    assert result.exit_code == 0
    (line,) = said
    assert line.startswith(f"children run without limits.memory_mb: {2**45} (the system refuses it: ")
    assert resource.getrlimit(resource.RLIMIT_AS) == before


@pytest.mark.skipif(sys.platform != "linux", reason="the limit of a child's memory is tested on Linux")
def test_memory_limit(run: Run) -> None:
    result = run("stages.grow.hog=[b]", "limits.memory_mb=2000")
    assert result.failures["b"].error == "ran out of memory (limits.memory_mb: 2000)"
    assert result.ok == ["a", "c", "d"]


def test_units_landmarks_and_roles_name_their_remedy(run: Run, scans: Path, tmp_path: Path) -> None:
    for i in "abc":
        write_mesh(scans / f"{i}.ply", tetrahedron(100.0))
    write_mesh(scans / "d.ply", tetrahedron(0.1))
    marks = {"a": {"tip": [0, 0, 0]}, "b": {"tip": [0, 0, -50]}, "c": {"tipp": [0, 0, 0]}, "d": {"tip": [0, 0, 0]}}
    (tmp_path / "marks.json").write_text(json.dumps(marks))
    stages = [{name: {"skip": True}} for name in ("smooth", "decimate", "align", "parameterize", "sample", "fit")]
    stages += [{name: {"skip": True}} for name in ("optimize", "model", "evaluate", "report")]
    given = {"landmarks": "marks.json", "roles": {"trim": "tip"}}
    chain = [*stages, {"orient": {"frame": "none", "mirror": "none"}}]
    result = run(anatomy="femur-distal", stages=chain, input=given)
    lines = {i: failure.line for i, failure in result.failures.items()}
    assert set(lines) >= {"b", "c", "d"}
    assert lines["b"].startswith(
        "b, repair, b.ply: landmark 'tip' is 50.0 mm away from the surface, at most 20 is accepted"
    )
    assert lines["c"].startswith(
        "c, trim, c.ply: landmark 'tip' (role 'trim') is missing; this shape has 'tipp'; try: "
    )
    assert lines["d"] == (
        "d, repair, d.ply: bounding box diagonal is 0.173 mm, femur-distal expects 60-700 mm; try: set input.units: m"
    )


@pytest.mark.parametrize(
    ("factor", "remedy"),
    [
        (0.1, "multiply the landmarks by 10: they have other units"),
        (1000.0, "multiply the landmarks by 0.001: they have other units"),
        ([-1, -1, 1], "change the signs of x and y of the landmarks"),
        ([1, 1, -1], "check that landmarks and scan belong together"),
        (0.0, "check that landmarks and scan belong together"),
    ],
)
def test_landmarks_in_other_units_or_frames_are_recognized(factor: Any, remedy: str) -> None:
    scan = tetrahedron(100.0, at=300.0)
    marks = {f"m{k}": np.array(factor) * place for k, place in enumerate(scan.vertices)}
    with pytest.raises(LandmarkError) as caught:
        check_landmarks(scan, marks, 20.0, "mm")
    assert str(caught.value.remedy).startswith(remedy)
    with pytest.raises(LandmarkError, match="check that landmarks and scan belong together"):
        check_landmarks(scan, dict(list(marks.items())[:2]), 20.0, "mm")  # two may fit by chance


def test_too_few_shapes(run: Run, project: Load) -> None:
    result = run("stages.grow.refuse=[a, b]")
    assert (result.exit_code, result.report) == (3, None)
    assert result.problem == (
        "'total' was not run: 2 of 4 shapes are left, at least 3 are needed (min_shapes); "
        "try: mend the shapes that failed, add scans, or lower min_shapes"
    )
    tasks = status_of(project("stages.grow.refuse=[a, b]"))
    (total,) = (t for t in tasks if t.step == "total")
    assert (total.state, total.reason) == ("to do", result.problem.replace("'total' was not run", "blocked"))
    result = run("stages.grow.refuse=[a]", "max_failed_fraction=0.2")
    assert "more than 0.2 failed (max_failed_fraction); try: mend" in result.problem
    result = run("stages.grow.refuse=[a, b, c, d]")
    assert result.problem == (
        "'shift': no shape is left; try: mend the shapes that failed, each is named above with its remedy"
    )


def test_group_stage_that_refuses(run: Run, tmp_path: Path) -> None:
    result = run("stages.total.refuse=true")
    assert result.exit_code == 3
    assert json.loads((tmp_path / "out/failures.json").read_text()) == {
        "(cohort)": {"stage": "total", "error": "the shapes do not agree", "remedy": "look at them"}
    }
    assert run().exit_code == 0
    assert not (tmp_path / "out/failures.json").exists()


def test_unreadable_scan(run: Run, scans: Path) -> None:
    (scans / "b.ply").write_bytes(b"ply\nnonsense")
    (scans / "c.ply").write_bytes(b"")
    result = run(min_shapes=2)
    assert set(result.failures) == {"b", "c"}
    assert result.failures["c"].line.startswith("c, grow, c.ply: the file is empty")


@pytest.mark.parametrize(("units", "hint"), [("mm", "m"), ("cm", "m")])
def test_wrong_units_are_refused(scans: Path, project: Load, units: str, hint: str) -> None:
    from dataclasses import replace

    source = replace(
        next(iter(project().sources.values())), units=units, diagonal_mm=(60.0, 700.0), anatomy="femur-distal"
    )
    write_mesh(source.path, tetrahedron(0.3))
    with pytest.raises(SsmpipeError, match=rf"femur-distal expects 60-700 mm; try: set input\.units: {hint}"):
        source.load()
    assert replace(source, units="m").load()["mesh"].vertices.max() == pytest.approx(300.0)
    assert replace(source, units="none").load()["mesh"].vertices.max() == pytest.approx(0.3)


def test_landmark_far_from_the_surface(run: Run, tmp_path: Path) -> None:
    marks = {
        i: {"tip": [0, 0, 0], "apex": [-50, 0, 0] if i == "b" else [-8.0 + 3 * k, 0, 0]} for k, i in enumerate("abcd")
    }
    (tmp_path / "marks.json").write_text(json.dumps(marks))
    result = run(input={"landmarks": "marks.json"})
    assert set(result.failures) == {"b"}
    line = result.failures["b"].line
    assert "landmark 'apex' is 53.2 mm away from the surface, at most 20 is accepted" in line
    assert "input.landmark_tolerance" in line
    manifest = read_manifest(tmp_path / "out/shapes/a/01-grow")
    assert manifest is not None
    assert manifest.warnings[0].startswith("landmark 'apex' is 8.0 mm away")


def test_missing_landmark_matters_only_to_who_needs_it(run: Run, tmp_path: Path) -> None:
    (tmp_path / "marks.json").write_text(json.dumps({i: {"tip": [0, 0, 0]} for i in "abc"}))
    given = {"landmarks": "marks.json", "roles": {"apex": "tip"}, "landmark_tolerance": 50}
    assert run(input=dict(given)).exit_code == 0
    result = run("stages.shift.need=apex", input=dict(given))
    assert set(result.failures) == {"d"}
    assert "landmark 'tip' (role 'apex') is missing" in result.failures["d"].line


# --- what a crash leaves ---


def test_crash_while_writing_leaves_no_manifest(project: Load, monkeypatch: pytest.MonkeyPatch) -> None:
    workspace = make_workspace(project())
    step = workspace.plan.step("grow")

    def stop(*_: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(execute, "publish", stop)
    with pytest.raises(KeyboardInterrupt):
        run_task(workspace, step, "a")
    assert not workspace.folder(step, "a").exists()
    assert list(workspace.scratch.iterdir()) == []
    monkeypatch.undo()
    assert run_task(workspace, step, "a").reason == "first run"
    assert run_task(workspace, step, "a").status == "up to date"


def test_a_group_stage_that_loses_its_cluster_is_no_failure_of_the_cohort(
    project: Load, monkeypatch: pytest.MonkeyPatch
) -> None:
    workspace = make_workspace(project())

    def lost(*_: Any, **__: Any) -> None:
        raise ClusterLostError("no dask worker has been there for 3 s")

    monkeypatch.setattr(batch, "run_task", lost)
    outcome = run_job(Job(workspace, ("total",), None, ("a",)), workspace.scratch / "events", None)
    assert (outcome.lost, outcome.failure) == ("no dask worker has been there for 3 s", None)
    assert not (workspace.out / "cohort").exists()


def test_a_group_stage_gets_the_cores_of_the_children(project: Load, run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    jobs: list[Job] = []
    run_all = batch.Batch.run

    def watched(self: batch.Batch, some: Sequence[Job], finished: Any) -> None:
        jobs.extend(some)
        run_all(self, some, finished)

    monkeypatch.setattr(batch.Batch, "run", watched)
    run(options=RunOptions(jobs=3))
    assert {(job.steps[-1], job.threads) for job in jobs if job.shape is None and not job.prepare} == {("total", 3)}
    assert {job.threads for job in jobs if job.shape is not None} == {1}
    contexts = []
    monkeypatch.setattr(execute, "_call", lambda stage, given, cfg, ctx, prepare: contexts.append(ctx))
    workspace = make_workspace(project())
    run_job(Job(workspace, ("total",), None, ("a",), frozenset({"total"}), threads=3), workspace.scratch / "e", None)
    assert [ctx.threads for ctx in contexts] == [3]


def test_old_output_stays_until_the_new_one_is_complete(project: Load, monkeypatch: pytest.MonkeyPatch) -> None:
    workspace = make_workspace(project())
    step = workspace.plan.step("grow")
    run_task(workspace, step, "a")
    before = tree(workspace.folder(step, "a"))

    def full(*_: Any, **__: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(execute, "save_artifact", full)
    with pytest.raises(DiskError, match="No space left"):
        run_task(workspace, step, "a", force=True)
    assert tree(workspace.folder(step, "a")) == before
    outcome = run_job(Job(workspace, ("grow",), "a", forced=frozenset({"grow"})), workspace.scratch / "events", None)
    assert "No space left on device" in outcome.disk
    assert outcome.failure is None


def test_killed_run_is_swept_and_continued(run: Run, tmp_path: Path) -> None:
    run(options=RunOptions(jobs=2, last="grow"))
    left = tmp_path / "out/.work/a-01-grow-xyz"
    left.mkdir(parents=True)
    (left / "mesh.ply").write_text("half")
    shutil.rmtree(tmp_path / "out/shapes/b/01-grow")
    result = run()
    assert (result.n_run, result.exit_code) == (6, 0)
    assert not left.exists()


def test_lock(run: Run, project: Load, tmp_path: Path) -> None:
    out = project().out
    with locked(out), pytest.raises(LockHeldError, match=rf"process {os.getpid()}, since \d"):
        run()
    with locked(out, "1-of-2"):
        with pytest.raises(LockHeldError):
            run()
        with locked(out, "2-of-2"):
            pass
    with locked(out), pytest.raises(LockHeldError), locked(out, "1-of-2"):
        pass
    assert run().exit_code == 0


# --- parts of a run ---


def test_single_shape_uses_what_was_prepared(run: Run, tmp_path: Path) -> None:
    run("stages.shift.noise=0.1")
    reference = (tmp_path / "out/cohort/02-shift-prepare/manifest.json").stat().st_mtime_ns
    shutil.rmtree(tmp_path / "out/shapes/a")
    result = run("stages.shift.noise=0.1", options=RunOptions(shapes=("a",)))
    assert (result.ok, result.n_run, result.exit_code) == (["a"], 2, 0)
    assert reference == (tmp_path / "out/cohort/02-shift-prepare/manifest.json").stat().st_mtime_ns
    shutil.rmtree(tmp_path / "out")
    result = run("stages.shift.noise=0.1", options=RunOptions(shapes=("a",)))
    assert result.exit_code == 0
    assert [(tmp_path / f"out/shapes/{i}/01-grow").exists() for i in "abcd"] == [True] * 4
    assert [(tmp_path / f"out/shapes/{i}/02-shift").exists() for i in "abcd"] == [True, False, False, False]
    assert not (tmp_path / "out/cohort/total").exists()


def test_reference_by_name_needs_only_that_shape(run: Run, tmp_path: Path) -> None:
    result = run("stages.shift.reference=c", options=RunOptions(shapes=("a",)))
    assert result.exit_code == 0
    assert [(tmp_path / f"out/shapes/{i}/01-grow").exists() for i in "abcd"] == [True, False, True, False]
    full = run("stages.shift.reference=c")
    assert (full.n_run, full.n_current) == (6, 3)
    refused = run("stages.shift.reference=c", "stages.grow.refuse=[c]")
    assert refused.exit_code == 3
    assert "its reference shape c failed" in refused.problem


def test_reference_from_a_file(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_mesh(tmp_path / "ref.ply", tetrahedron(10, 500))
    assert run("stages.shift.reference=ref.ply").exit_code == 0
    assert read_mesh(tmp_path / "out/shapes/a/02-shift/mesh.ply").vertices.mean() == pytest.approx(502.5)
    assert not (tmp_path / "out/cohort/02-shift-prepare").exists()
    shutil.copy(tmp_path / "ref.ply", tmp_path / "other.ply")
    assert run("stages.shift.reference=other.ply").n_run == 0
    write_mesh(tmp_path / "ref.ply", tetrahedron(11, 500))
    assert run("stages.shift.reference=ref.ply").n_run == 5


def test_parts(run: Run, project: Load, tmp_path: Path) -> None:
    for number in (1, 2):
        result = run(options=RunOptions(part=(number, 2), last="grow"))
        assert (result.exit_code, result.n_run) == (0, 2)
    assert (tmp_path / "out/run.part-1-of-2.json").exists()
    result = run()
    assert (result.n_run, result.n_current) == (5, 4)
    assert run(options=RunOptions(part=(2, 2))).ok == ["b", "d"]
    with pytest.raises(ConfigError, match="--part 3/2"):
        run(options=RunOptions(part=(3, 2)))


def test_a_part_makes_the_reference_that_no_other_part_has_made(run: Run, tmp_path: Path) -> None:
    first = run(options=RunOptions(part=(1, 2)))
    assert (first.exit_code, first.ok, first.n_run) == (0, ["a", "c"], 6)
    assert [(tmp_path / f"out/shapes/{i}/02-shift").exists() for i in "abcd"] == [True, False, True, False]
    second = run(options=RunOptions(part=(2, 2)))
    assert (second.exit_code, second.ok, second.n_run) == (0, ["b", "d"], 2)
    assert run().n_run == 1


def test_only_needs_what_comes_before(run: Run) -> None:
    with pytest.raises(ConfigError, match="stage 'total' needs 'mesh' of stage 'shift', which has not been run"):
        run(options=RunOptions(only=("total",)))
    run(options=RunOptions(last="shift"))
    assert run(options=RunOptions(only=("total",))).n_run == 1
    assert run(options=RunOptions(only=("total",), forced=frozenset({"*"}))).n_run == 1


def test_failed_shape_stays_out_of_a_later_group_stage(run: Run, tmp_path: Path) -> None:
    run()
    run("stages.grow.refuse=[a]", options=RunOptions(last="shift"))
    assert set(json.loads((tmp_path / "out/failures.json").read_text())) == {"a"}
    result = run("stages.grow.refuse=[a]", options=RunOptions(only=("total",)))
    assert result.exit_code == 0
    assert read_manifest(tmp_path / "out/cohort/total").metrics == {"n_shapes": 3}  # type: ignore[union-attr]
    assert set(json.loads((tmp_path / "out/failures.json").read_text())) == {"a"}


def test_renumbered_folders_are_kept(run: Run, tmp_path: Path) -> None:
    run()
    result = run(stages=[{"grow": {"id": "pre"}}, {"grow": {"from": {"mesh": "scan"}}}, "shift", "total"])
    assert (result.n_run, result.n_current) == (4, 9)
    assert sorted(p.name for p in (tmp_path / "out/shapes/a").iterdir()) == ["01-pre", "02-grow", "03-shift"]


def test_status(run: Run, project: Load, tmp_path: Path) -> None:
    def states(*overrides: str) -> dict[tuple[str, str], str]:
        return {(t.step, t.shape): t.state for t in status_of(project(*overrides))}

    assert set(states().values()) == {"to do"}
    run("stages.grow.refuse=[a]")
    found = states("stages.grow.refuse=[a]")
    assert found["grow", "a"] == "failed"
    assert found["shift", "a"] == "to do"
    assert {s for k, s in found.items() if k[1] != "a"} == {"done"}
    stale = states("stages.grow.refuse=[a]", "stages.total.weight=3")
    assert [k for k, s in stale.items() if s == "stale"] == [("total", "")]


def test_status_counts_a_failed_shape_in_every_stage(
    run: Run, project: Load, capsys: pytest.CaptureFixture[str]
) -> None:
    chain = ["grow", "shift", {"grow": {"id": "late", "refuse": ["d"]}}, "total"]
    run(stages=chain)
    one = project(stages=chain)
    tasks = status_of(one)
    states = {(t.step, t.shape): t.state for t in tasks}
    assert (states["grow", "d"], states["shift", "*"], states["shift", "d"], states["late", "d"]) == (
        *("done",) * 3,
        "failed",
    )
    assert set(states.values()) == {"done", "failed"}
    print_status(tasks, one, Console(0))
    table = capsys.readouterr().out
    rows = {row[0]: row[1:6] for line in table.splitlines() if (row := [c.strip() for c in line.split("│")[1:-1]])}
    assert rows["grow"] == ["4", "-", "-", "-", "-"]
    assert rows["late"] == ["3", "-", "-", "-", "1"]


def test_a_column_that_no_stage_reads_makes_nothing_stale(run: Run, project: Load, tmp_path: Path) -> None:
    def table(side: str, age: int) -> None:
        (tmp_path / "cohort.csv").write_text(f"id,side,age\na,{side},{age}\nb,R,1\nc,R,1\nd,R,1\n")

    chain = {"stages": [{"orient": {"frame": "none"}}, "shift", "total"], "input": {"cohort": "cohort.csv"}}
    table("R", 1)
    run(**chain)
    table("R", 2)
    assert {t.state for t in status_of(project(**chain))} == {"done"}
    assert run(**chain).n_run == 0
    table("L", 2)
    tasks = {(t.step, t.shape): (t.state, t.certain) for t in status_of(project(**chain))}
    assert tasks["orient", "a"] == ("stale", True)
    assert tasks["shift", "a"] == ("stale", False)
    assert tasks["orient", "b"] == ("done", True)
    assert {t["reason"] for t in _ran(run(**chain), tmp_path)} >= {"input changed: info", "input changed: mesh"}


def _ran(result: RunResult, tmp_path: Path) -> list[dict[str, Any]]:
    assert result.exit_code == 0
    return [t for t in entries(tmp_path / "out").values() if t["status"] == "done"]


def test_new_shape_runs_alone_until_the_group(run: Run, scans: Path, project: Load) -> None:
    run()
    write_mesh(scans / "aa.ply", tetrahedron(5.0))
    result = run()
    assert (result.n_run, result.n_current) == (3, 8)
    found = run_project(project(), RunOptions(jobs=1), Console(-1))
    assert found.n_run == 0


def test_toys_exist() -> None:
    assert sorted(p.stem for p in TOY.glob("*.py")) == ["grow", "results", "shift", "total"]
