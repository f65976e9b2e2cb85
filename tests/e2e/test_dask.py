"""Runs on a dask cluster: the same bytes as a run on this machine, whatever dies on the way."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from ssmpipe.io.splines import write_spline
from ssmpipe.runner import dask_engine
from ssmpipe.runner.cluster import slurm_cluster
from ssmpipe.runner.config import SlurmConfig
from ssmpipe.runner.dask_engine import DaskEngine
from ssmpipe.runner.patience import ClusterLostError
from ssmpipe.runner.project import Project
from tests.support.engines import Killing, optimized
from tests.support.surfaces import bumps
from tests.support.toys import TOY

distributed = pytest.importorskip("distributed", reason="needs ssmpipe[dask]")
pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    cluster = distributed.LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        host="127.0.0.1",
        dashboard_address=None,
        memory_limit=0,
        local_directory=str(tmp_path_factory.mktemp("dask")),
        silence_logs=60,
    )
    with distributed.Client(cluster) as client:
        yield client
    cluster.close()


def workers(client: Any) -> list[int]:
    return list(client.run(os.getpid).values())


def data(out: Path) -> dict[str, bytes]:
    skip = ("timing.json", "history.csv")
    return {
        str(p.relative_to(out)): p.read_bytes()
        for folder in ("shapes", "cohort")
        for p in sorted((out / folder).rglob("*"))
        if p.is_file() and p.name not in skip
    }


def run(config: Path, *options: str, expected: int = 0) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "ssmpipe", "run", str(config), *options]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=300, env={**os.environ, "SSMPIPE_STAGES": str(TOY)}
    )
    assert done.returncode == expected, done.stdout + done.stderr
    return done


def test_the_optimization_has_the_same_bits_on_dask_also_when_a_worker_is_killed(client: Any, tmp_path: Path) -> None:
    serial = optimized(None)
    engine = DaskEngine(client, tmp_path / "shared")
    assert optimized(engine) == serial
    assert engine.n_tasks == 0
    killing = Killing(engine, lambda: workers(client), after=7)
    assert optimized(killing) == serial
    assert killing.n_killed == 1
    assert 1 <= engine.n_tasks <= 4  # then actors again
    engine.close()
    assert list(tmp_path.iterdir()) == []
    client.wait_for_workers(2, timeout=60)


def test_a_worker_that_does_not_answer_is_left_alone(
    client: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dask_engine, "_LOOK_EVERY_S", 0.5)
    monkeypatch.setattr(dask_engine, "_NO_ANSWER_S", 2.0)
    engine = DaskEngine(client, tmp_path / "shared")
    first, second = engine.call(os.getpid, [(), ()])
    os.kill(first, signal.SIGSTOP)
    try:
        assert engine.call(os.getpid, [(), ()]) == [second, second]
        assert engine.call(os.getpid, [(), ()]) == [second, second]
        assert engine.n_tasks == 1
    finally:
        os.kill(first, signal.SIGCONT)
    with pytest.raises(ZeroDivisionError):
        engine.call(divmod, [(1, 1), (1, 0)])
    assert engine.n_tasks == 1
    engine.close()


def test_a_whole_run_on_an_own_cluster_gives_the_same_bytes(tmp_path: Path) -> None:
    (tmp_path / "scans").mkdir()
    for k, surface in enumerate(bumps(4)):
        write_spline(tmp_path / f"scans/s{k}.npz", surface)
    config = tmp_path / "group.yaml"
    config.write_text(
        "name: group\ninput: {scans: scans/*.npz}\noutput: here\nstages:\n"
        "  - optimize: {n_coefficients: [5, 5], landmarks: [21, 21], max_iterations: 6, landmark_blocks: 3}\n  - model\n"
    )
    run(config)
    done = run(config, "--executor", "dask", "-j", "2", "--set", f"output={tmp_path / 'there'}")
    assert "dask: tcp://127.0.0.1" in done.stdout
    assert data(tmp_path / "there") == data(tmp_path / "here")
    assert not (tmp_path / "there/.work").exists()


def test_patients_on_workers_are_guarded_and_a_killed_worker_changes_nothing(
    client: Any, write_config: Callable[..., Path]
) -> None:
    bad = {"abort": ["a"], "hang": ["b"]}
    limits = {"timeout_s": 8}
    config = write_config(stages=[{"grow": bad}, {"shift": {"noise": 0.1}}], limits=limits)
    here, there = config.parent / "out", config.parent / "there"
    run(config, expected=3)
    command = [sys.executable, "-m", "ssmpipe", "run", str(config), "-q", "--set", f"output={there}"]
    command += ["--executor", "dask", "--scheduler", client.scheduler.address]
    process = subprocess.Popen(
        command, env={**os.environ, "SSMPIPE_STAGES": str(TOY)}, stderr=subprocess.PIPE, text=True
    )
    deadline = time.monotonic() + 120
    while not (there / "shapes/c/01-grow").exists() and time.monotonic() < deadline:
        time.sleep(0.02)
    os.kill(workers(client)[0], signal.SIGKILL)
    _, errors = process.communicate(timeout=300)
    assert process.returncode == 3, errors
    assert "a, grow, a.ply: the process crashed (SIGABRT)" in errors
    assert "b, grow, b.ply: did not finish within 8 s" in errors
    assert data(there) == data(here)


def test_an_encrypted_cluster(tmp_path: Path, write_config: Callable[..., Path]) -> None:
    security = distributed.Security.temporary()
    for name, text in (("ca", "ca_file"), ("cert", "client_cert"), ("key", "client_key")):
        (tmp_path / f"{name}.pem").write_text(getattr(security, f"tls_{text}"))
    tls = {"ca_file": "ca.pem", "cert": "cert.pem", "key": "key.pem"}
    cluster = distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, host="127.0.0.1", protocol="tls://", security=security, dashboard_address=None,
        memory_limit=0, local_directory=str(tmp_path / "dask"), silence_logs=60,
    )  # fmt: skip
    try:
        address = cluster.scheduler_address
        assert address.startswith("tls://")
        config = write_config(stages=["grow", "shift", "total"], executor="dask", scheduler=address, tls=tls)
        assert "4 shapes ok" in run(config).stdout
        config = write_config(stages=["grow"], executor="dask", scheduler=address)
        assert "needs certificates" in run(config, expected=2).stderr
    finally:
        cluster.close()


def test_a_scheduler_that_is_not_there_is_named(write_config: Callable[..., Path]) -> None:
    config = write_config(stages=["grow"])
    from ssmpipe.runner import cluster

    assert cluster._WAIT_S == 60
    code = (
        "import ssmpipe.runner.cluster as c; c._WAIT_S = 2; from ssmpipe.cli import main; "
        f"main(['run', {str(config)!r}, '--executor', 'dask', '--scheduler', 'tcp://127.0.0.1:9'])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env={**os.environ, "SSMPIPE_STAGES": str(TOY)}
    )
    assert done.returncode == 2
    assert "scheduler: tcp://127.0.0.1:9 cannot be reached" in done.stderr
    assert "Traceback" not in done.stderr


def test_the_job_script_for_slurm(tmp_path: Path, project: Callable[..., Project]) -> None:
    pytest.importorskip("dask_jobqueue", reason="needs ssmpipe[dask]")
    slurm = {"queue": "long", "cores": 8, "memory": "32GB", "walltime": "02:00:00", "account": "ortho"}
    config = project(executor="dask", scheduler={"slurm": {**slurm, "directives": ["--constraint=avx2"]}}).config
    assert isinstance(config.slurm, SlurmConfig)
    cluster = slurm_cluster(config.slurm, tmp_path / "slurm")
    try:
        script = cluster.job_script()
        address = cluster.scheduler_address
    finally:
        cluster.close()
    for line in ("-p long", "-A ortho", "-t 02:00:00", "--cpus-per-task=8", "--constraint=avx2"):
        assert f"#SBATCH {line}" in script
    assert address.startswith("tls://")
    assert "tls://" in script
    assert "--nworkers 8" in script
    assert "--nthreads 1" in script
    for option in ("--tls-ca-file", "--tls-cert", "--tls-key"):
        assert option in script
    assert sys.executable in script
    assert "OMP_NUM_THREADS=1" in script


def test_workers_that_vanish_end_the_run_and_nothing_is_lost(tmp_path: Path, write_config: Callable[..., Path]) -> None:
    cluster = distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, host="127.0.0.1", dashboard_address=None, memory_limit=0,
        local_directory=str(tmp_path / "dask"), silence_logs=60,
    )  # fmt: skip
    try:
        stages = [{"grow": {"hang": ["d"]}}, {"shift": {"noise": 0.1}}, "total"]
        config = write_config(stages=stages, limits={"worker_wait_s": 3})
        address = cluster.scheduler_address
        command = [sys.executable, "-m", "ssmpipe", "run", str(config), "--executor", "dask", "--scheduler", address]
        process = subprocess.Popen(
            command,
            env={**os.environ, "SSMPIPE_STAGES": str(TOY)},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        out = config.parent / "out"
        deadline = time.monotonic() + 120
        while not (out / "shapes/c/01-grow").exists() and time.monotonic() < deadline:
            time.sleep(0.02)
        cluster.scale(0)
        _, errors = process.communicate(timeout=120)
        assert process.returncode == 74, errors
        assert "warning: no dask worker is there; the run waits up to 3 s for one" in errors
        assert "no dask worker has been there for 3 s; try: start the cluster again and run the same command" in errors
        assert not (out / "failures.json").exists()
        assert not (out / "shapes/d/failed.txt").exists()
        cluster.scale(1)
        done = run(config, "--executor", "dask", "--scheduler", address, "--shape", "a", "--shape", "c", "--to", "grow")
        assert "2 of 2 shapes are up to date" in done.stdout
        with distributed.Client(address, set_as_default=False) as own:
            engine = DaskEngine(own, tmp_path / "shared", worker_wait_s=2)
            assert engine.call(abs, [(-1,), (-2,)]) == [1, 2]
            cluster.scale(0)
            while own.nthreads():
                time.sleep(0.02)
            with pytest.raises(ClusterLostError, match="no dask worker has been there for 2 s"):
                engine.call(abs, [(-1,), (-2,)])
        cluster.scale(1)
        config = write_config(stages=["grow", *stages[1:]])
        assert "4 shapes ok" in run(config, "--executor", "dask", "--scheduler", address).stdout
    finally:
        cluster.close()


def test_a_scheduler_that_breaks_down_is_not_blamed_on_the_patients(
    tmp_path: Path, write_config: Callable[..., Path]
) -> None:
    code = (
        "import distributed, time\nif __name__ == '__main__':\n"
        "    cluster = distributed.LocalCluster(n_workers=1, threads_per_worker=1, host='127.0.0.1', dashboard_address=None,"
        f" memory_limit=0, local_directory={str(tmp_path / 'dask')!r}, silence_logs=60)\n"
        "    print(cluster.scheduler_address, flush=True)\n    time.sleep(600)\n"
    )
    (tmp_path / "head.py").write_text(code)
    head = subprocess.Popen([sys.executable, str(tmp_path / "head.py")], stdout=subprocess.PIPE, text=True)
    assert head.stdout is not None
    address = head.stdout.readline().strip()
    config = write_config(stages=[{"grow": {"hang": ["d"]}}, "total"], limits={"worker_wait_s": 3})
    command = [sys.executable, "-m", "ssmpipe", "run", str(config), "--executor", "dask", "--scheduler", address]
    process = subprocess.Popen(
        command,
        env={**os.environ, "SSMPIPE_STAGES": str(TOY)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    deadline = time.monotonic() + 120
    while not (config.parent / "out/shapes/c/01-grow").exists() and time.monotonic() < deadline:
        time.sleep(0.02)
    head.kill()
    head.wait()
    _, errors = process.communicate(timeout=200)
    assert process.returncode == 74, errors
    assert "start the cluster again and run the same command" in errors
    assert not (config.parent / "out/failures.json").exists()
