"""Commands as a user types them: exit codes, lines on the console, nothing imported for help."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

from ssmpipe.cli import main
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.io.meshes import write_mesh
from ssmpipe.runner.lock import locked
from ssmpipe.runner.project import load_project
from tests.support.toys import TOY, tetrahedron

Call = Callable[..., Result]


@pytest.fixture
def call(monkeypatch: pytest.MonkeyPatch) -> Call:
    monkeypatch.setenv("SSMPIPE_STAGES", str(TOY))

    def invoke(*args: object) -> Result:
        return CliRunner().invoke(main, [str(a) for a in args])

    return invoke


@pytest.fixture
def config(write_config: Callable[..., Path]) -> Path:
    return write_config()


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys\n"
        "from click.testing import CliRunner\n"
        "from ssmpipe.cli import main\n"
        "result = CliRunner().invoke(main, ['--help'])\n"
        "assert result.exit_code == 0 and 'decimate' in result.output, result.output\n"
        "for name in ('run', 'check', 'status', 'init', 'report', 'schema', 'synth'):\n"
        "    assert CliRunner().invoke(main, [name, '--help']).exit_code == 0\n"
        "heavy = {'numpy', 'scipy', 'pydantic', 'igl', 'trimesh', 'rich', 'ruamel', 'matplotlib'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


def test_every_stage_command_lists_every_option(call: Call) -> None:
    from ssmpipe.runner.registry import Registry

    registry = Registry()
    for name in registry.files():
        result = call(name, "--help")
        assert result.exit_code == 0, result.output
        for field in registry.load(name).config.model_fields:
            assert f"--{field.replace('_', '-')}" in result.output
        assert "[default:" in " ".join(result.output.split())


def test_run_then_nothing_to_do(call: Call, config: Path) -> None:
    result = call("run", config, "-j", 2)
    assert result.exit_code == 0, result.output
    assert "4 shapes ok, 0 failed, 9 tasks run" in result.output
    result = call("run", config)
    assert "nothing to do: 9 tasks up to date" in result.output
    result = call("run", config, "-n", "--set", "stages.total.weight=2")
    assert "run  total: config changed: weight" in result.output
    assert "1 task would run, 8 up to date" in result.output
    result = call("run", "--only", "total", "--force", config)
    assert (result.exit_code, "1 task run" in result.output) == (0, True)
    result = call("run", config, "-q", "--force", "total")
    assert result.output == ""


def test_failed_shapes_give_3(call: Call, config: Path) -> None:
    result = call("run", config, "--set", "stages.grow.refuse=[a]")
    assert result.exit_code == 3
    assert "failed: a, grow, a.ply: the mesh has 2 components; try: keep the largest" in result.output
    assert "3 shapes ok, 1 failed" in result.output
    status = call("status", config, "--set", "stages.grow.refuse=[a]")
    assert status.exit_code == 0
    assert "failed: a, grow, a.ply: the mesh has 2 components" in status.output
    tasks = json.loads(call("status", config, "--json").output)["tasks"]
    assert {"step", "shape", "state", "reason"} == set(tasks[0])


@pytest.mark.parametrize(
    ("args", "text"),
    [
        (["run", "none.yaml"], "none.yaml: cannot read the config file"),
        (["run"], "Missing argument 'CONFIG.yaml'"),
        (["rum"], "No such command 'rum'"),
        (["decimat"], "decimate"),
        (["run", "CONFIG", "--set", "seed"], "write it as key.path=value"),
        (["run", "CONFIG", "--set", "sed=1"], "did you mean 'seed'?"),
        (["run", "CONFIG", "--from", "grwo"], "did you mean 'grow'?"),
        (["run", "CONFIG", "--part", "x"], "not of the form i/N"),
        (["run", "CONFIG", "--jobs", "0"], "0 is not in the range"),
        (["run", "CONFIG", "--only", "total", "--to", "grow"], "--only cannot be combined"),
        (["report", "CONFIG"], "this chain has no stage 'report'"),
        (["init", "femur", ".", "-o", "x.yaml"], "unknown anatomy 'femur'"),
    ],
)
def test_usage_errors_give_2(call: Call, config: Path, args: list[str], text: str) -> None:
    result = call(*(config if a == "CONFIG" else a for a in args))
    assert result.exit_code == 2, result.output
    assert text in result.output
    assert "Traceback" not in result.output


def test_help_of_init_names_every_anatomy(call: Call) -> None:
    from ssmpipe.runner.presets import PRESETS

    words = set(call("init", "--help").output.replace(",", " ").split())
    assert set(PRESETS) <= words


def test_lock_held_gives_75(call: Call, config: Path) -> None:
    with locked(config.parent / "out"):
        result = call("run", config)
    assert result.exit_code == 75
    assert f"process {os.getpid()}" in result.output


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_unwritable_output_gives_74(call: Call, config: Path) -> None:
    (config.parent / "out").mkdir(mode=0o500)
    assert call("run", config).exit_code == 74


def test_output_that_is_a_file_gives_74(call: Call, config: Path) -> None:
    (config.parent / "out").write_text("in the way")
    result = call("run", config)
    assert result.exit_code == 74
    assert "cannot read or write" in result.output


def test_internal_error_gives_1(call: Call, config: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import ssmpipe.runner.project as module

    monkeypatch.setattr(module, "make_plan", lambda *_: 1 / 0)
    result = call("run", config)
    assert result.exit_code == 1
    assert "internal error: ZeroDivisionError" in result.output
    assert "Traceback" not in result.output
    assert isinstance(call("--debug", "run", config).exception, ZeroDivisionError)


@pytest.mark.parametrize("moment", [0.05, 0.12, 0.2, "in the middle"])
def test_interrupt_gives_130_and_keeps_what_is_done(write_config: Callable[..., Path], moment: float | str) -> None:
    config = write_config(stages=[{"grow": {"hang": ["d"]}}, "shift", "total"])
    env = {**os.environ, "SSMPIPE_STAGES": str(TOY)}
    # a shell that runs the tests in the background lets them ignore SIGINT
    code = (
        "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "from ssmpipe.cli import main; main(sys.argv[1:])"
    )
    command = [sys.executable, "-c", code, "run", str(config), "-j", "1"]
    awaited = config.parent / ("out/shapes/c/01-grow" if moment == "in the middle" else "out/.work")
    with subprocess.Popen(
        command, env=env, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        try:
            deadline = time.monotonic() + 30
            while not awaited.exists() and time.monotonic() < deadline:
                time.sleep(0.01)
            time.sleep(moment if isinstance(moment, float) else 0.0)  # children are starting
            os.killpg(process.pid, signal.SIGINT)  # as a terminal does: to parent and children
            _, err = process.communicate(timeout=30)
        finally:
            process.kill()
    assert process.returncode == 130, err
    assert "interrupted; what is finished is kept" in err
    assert "Traceback" not in err
    if moment == "in the middle":
        assert sorted(p.name for p in (config.parent / "out/shapes").iterdir()) == ["a", "b", "c"]


@pytest.mark.parametrize("command", [["run"], ["run", "-n"], ["status"], ["status", "--json"], ["check"], ["schema"]])
def test_a_closed_pipe_ends_it_quietly(config: Path, command: list[str]) -> None:
    arguments = [*command, *([] if command == ["schema"] else [str(config)])]
    env = {**os.environ, "SSMPIPE_STAGES": str(TOY)}
    reader, writer = os.pipe()
    os.close(reader)
    with open(writer, "wb") as closed:
        done = subprocess.run(
            [sys.executable, "-m", "ssmpipe", *arguments], env=env, stdout=closed, stderr=subprocess.PIPE, timeout=60
        )
    assert (done.returncode, done.stderr) == (141, b"")


def test_init_writes_a_config_that_loads(call: Call, scans: Path, tmp_path: Path) -> None:
    (tmp_path / "cohort.csv").write_text("id,side\na,L\nb,R\nc,R\nd,L\n")
    for anatomy in ("femur-distal", "disk"):
        target = tmp_path / f"{anatomy}.yaml"
        result = call("init", anatomy, scans, "-o", target)
        assert result.exit_code == 0, result.output
        text = target.read_text()
        assert "scans: scans/*.ply" in text
        assert "cohort: cohort.csv" in text
        assert "# landmarks:" in text
        assert "repair (prepare)" not in call("run", target, "-n").output
        assert call("run", target, "-n").exit_code == 0
        with_options = text.replace("#  - decimate:", "  - decimate:").replace("#      n_faces:", "      n_faces:")
        target.write_text(with_options)
        assert call("run", target, "-n").exit_code == 0
    # a disk has no side by itself; this table gives it one
    orient = dict(load_project(tmp_path / "disk.yaml").steps[1].options)
    assert (orient["mirror"], orient["frame"]) == ("left", "principal")
    assert call("init", "disk", scans, "-o", tmp_path / "disk.yaml").exit_code == 2
    (tmp_path / "cohort.csv").write_text("id,side\na,R\nb,R\n")
    result = call("init", "disk", scans, "-o", tmp_path / "disk.yaml", "--overwrite")
    assert (result.exit_code, "mirror" in result.output) == (0, False)
    assert load_project(tmp_path / "disk.yaml").steps[1].options["mirror"] == "none"
    (tmp_path / "hands/scans").mkdir(parents=True)
    (tmp_path / "hands/landmarks.csv").write_text("id,landmark,x,y\n")
    (tmp_path / "hands/scans/one.csv").write_text("x,y\n0,0\n1,0\n")
    result = call("init", "curve", tmp_path / "hands", "-o", tmp_path / "hands.yaml")
    assert result.exit_code == 2
    assert f"no scans in the folder {tmp_path / 'hands'}; {tmp_path / 'hands/scans'} holds 1 scan" in result.output
    assert f"try: ssmpipe init curve {tmp_path / 'hands/scans'} -o {tmp_path / 'hands.yaml'}" in result.output
    assert call("init", "curve", tmp_path / "hands/scans", "-o", tmp_path / "hands.yaml").exit_code == 0
    (tmp_path / "empty").mkdir()
    result = call("init", "disk", tmp_path / "empty", "-o", tmp_path / "e.yaml")
    assert (result.exit_code, "no scans in the folder" in result.output) == (2, True)


def test_init_passes_over_folders_that_cannot_be_read(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("good", "locked", "old [1]"):  # the last one reads as a pattern
        (tmp_path / "hands" / name).mkdir(parents=True)
        (tmp_path / "hands" / name / "one.csv").write_text("x,y\n0,0\n1,0\n")
    entries = Path.iterdir

    def read(self: Path) -> Iterator[Path]:
        if self.name == "locked":
            raise PermissionError(13, "Permission denied", str(self))
        return entries(self)

    monkeypatch.setattr(Path, "iterdir", read)
    result = call("init", "curve", tmp_path / "hands", "-o", tmp_path / "hands.yaml")
    assert (result.exit_code, f"{tmp_path / 'hands/good'} holds 1 scan" in result.output) == (2, True), result.output


@pytest.mark.parametrize("command", ["project", "orient"])
def test_sides_are_shown_as_in_the_tables_and_read_in_both_cases(call: Call, command: str) -> None:
    assert "--side L|R" in re.sub(r"\s+", " ", call(command, "--help").output)
    for side, code in (("l", None), ("R", None), ("x", "Invalid value for '--side'")):
        output = call(
            command, "none.ply", "none2.ply", *(["-o", "out"] if command == "project" else []), "--side", side
        ).output
        assert ("Invalid value for '--side'" in output) is (code is not None), output


def test_what_is_up_to_date_is_told_beside_a_failed_scan(call: Call, write_config: Callable[..., Path]) -> None:
    config = write_config(stages=[{"grow": {"refuse": ["b"]}}, "shift", "total"])
    assert call("run", config).exit_code == 3
    again = call("run", config)
    assert again.exit_code == 3
    assert "grow: 3 of 4 shapes are up to date" in again.output


def test_check_table(call: Call, scans: Path, tmp_path: Path, write_config: Callable[..., Path]) -> None:
    two = tetrahedron()
    write_mesh(
        scans / "b.ply", TriMesh(np.vstack([two.vertices, two.vertices + 50]), np.vstack([two.faces, two.faces + 4]))
    )
    (scans / "c.ply").write_bytes(b"ply\nnonsense")
    marks = {"a": {"tip": [0, 0, 0]}, "d": {"tip": [-41.0, 9.0, 9.0]}}
    (tmp_path / "marks.json").write_text(json.dumps(marks))
    config = write_config(input={"landmarks": "marks.json"})
    result = call("check", config)
    assert result.exit_code == 3
    assert "b, b.ply: 2 components; 4 faces lie outside the largest" in result.output
    assert "refused: c, c.ply:" in result.output
    assert "refused: d, d.ply: landmark 'tip' is 50.0 mm away from the surface" in result.output
    assert "2 of 4 scans can be used" in result.output
    assert "group stages" not in result.output, "the toys have no optimize"
    for name in "cd":
        (scans / f"{name}.ply").unlink()
    assert call("check", config).exit_code == 0
    (config.parent / "file").write_text("")
    result = call("check", config, "--set", f"output={config.parent / 'file' / 'out'}")
    assert result.exit_code == 2
    assert "output: nothing can be written to" in result.stderr
    result = call("check", config, "--set", "stages.grow.refuse=[a]")
    assert (result.exit_code, "1 of 2 scans can be used" in result.output) == (3, True)
    assert "refused: a, a.ply: grow: the mesh has 2 components; try: keep the largest" in result.output


def test_schema_accepts_what_the_config_accepts(call: Call) -> None:
    schema = json.loads(call("schema").output)
    assert set(schema["required"]) == {"name", "input", "output"}
    stages = schema["properties"]["stages"]["items"]["oneOf"]
    assert "grow" in stages[0]["enum"]
    assert schema["$defs"]["grow"]["properties"]["factor"]["default"] == 2.0
    assert schema["$defs"]["grow"]["additionalProperties"] is False
