"""What a config file may say: its sections, keys and defaults."""

from __future__ import annotations

import re
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator


class _Section(BaseModel):
    model_config = ConfigDict(frozen=True, strict=True, extra="forbid")


class InputConfig(_Section):
    """Where the scans are and what is known of them."""

    scans: Annotated[
        str | list[str] | None,
        Field(
            description="Folder, file, glob pattern, or a list of them; the id of a shape is its file name without suffix."
        ),
    ] = None
    cohort: Annotated[
        str | None, Field(description="CSV table: id, then any of path, side (L/R), group, subject, age, ...")
    ] = None
    landmarks: Annotated[
        str | None,
        Field(
            description="Named points in scan coordinates: {id: {name: [x, y, z]}} as JSON, or Slicer, MeshLab, CSV files."
        ),
    ] = None
    units: Annotated[
        Literal["mm", "cm", "m", "um", "none"],
        Field(description="Length unit of scans and landmarks; none: keep as is."),
    ] = "mm"
    roles: Annotated[
        dict[str, str], Field(description="Which named landmark serves which step: {role: landmark name}.")
    ] = {}
    landmark_tolerance: Annotated[
        float, Field(gt=0, description="A landmark farther from its surface than this is refused [mm].")
    ] = 20.0


class LimitsConfig(_Section):
    """Limits of one child process, and how much work a killed one may lose."""

    timeout_s: Annotated[
        float | None, Field(gt=0, description="Longest time for the per-shape stages of one shape [s]; null: no limit.")
    ] = 3600.0
    memory_mb: Annotated[
        int | None, Field(ge=256, description="Largest address space of one child process [MB]; null: no limit.")
    ] = None
    checkpoint_every: Annotated[
        int | None,
        Field(ge=1, description="Iterations of the group optimization between two saved states; null: none is saved."),
    ] = 10
    worker_wait_s: Annotated[
        float | None,
        Field(
            gt=0,
            description="Longest time that a run on dask waits while no worker is there [s]; null: no limit. SLURM: from the first "
            "worker on.",
        ),
    ] = 300.0


class SlurmConfig(_Section):
    """Workers as SLURM jobs (dask-jobqueue); encrypted."""

    queue: Annotated[str | None, Field(description="Partition; null: that of the site.")] = None
    cores: Annotated[int, Field(ge=1, description="Worker processes of one SLURM job, one core each.")]
    memory: Annotated[str, Field(description="Memory of one SLURM job, such as 64GB.")]
    walltime: Annotated[str, Field(description="Time limit of a SLURM job, such as 04:00:00.")]
    account: Annotated[str | None, Field(description="Account to charge; null: that of the user.")] = None
    directives: Annotated[list[str], Field(description="Further #SBATCH options, such as '--constraint=avx2'.")] = []


class SchedulerConfig(_Section):
    """A scheduler that is started for the run."""

    slurm: SlurmConfig


class TlsConfig(_Section):
    """Certificates for a scheduler at tls://."""

    ca_file: Annotated[str, Field(description="Certificate of the authority that signed the others (PEM file).")]
    cert: Annotated[str, Field(description="Certificate of this client (PEM file).")]
    key: Annotated[str, Field(description="Private key of this client (PEM file).")]


class RunConfig(_Section):
    """Config of a run: from a folder of scans to a model."""

    name: Annotated[str, Field(min_length=1, max_length=200, description="Title of the study, shown in the report.")]
    input: InputConfig
    output: Annotated[str, Field(min_length=1, description="Output folder, relative to the config file.")]
    anatomy: Annotated[
        str | None,
        Field(
            description="Preset that fills `stages` with defaults; without one, `stages` is the whole chain in order."
        ),
    ] = None
    stages: Annotated[
        list[Any],
        Field(description="Stages with options; merged by name into the preset's chain when `anatomy` is given."),
    ] = []
    seed: Annotated[int, Field(ge=0, description="Seed of everything random.")] = 0
    min_shapes: Annotated[int, Field(ge=2, description="Group stages need at least this many shapes.")] = 3
    max_failed_fraction: Annotated[
        float,
        Field(ge=0, le=1, description="Group stages are not run when a larger fraction of the shapes failed [1]."),
    ] = 0.5
    limits: LimitsConfig = LimitsConfig()
    executor: Annotated[
        Literal["local", "dask"],
        Field(description="Where work is done: processes of this machine, or a dask cluster (needs ssmpipe[dask])."),
    ] = "local"
    scheduler: Annotated[
        str | SchedulerConfig,
        Field(
            description="With executor dask. local: a cluster on this machine; tcp://127.0.0.1:PORT or tls://HOST:PORT: one that "
            "runs; {slurm: {queue, cores, memory, walltime}}: SLURM jobs."
        ),
    ] = "local"
    tls: Annotated[TlsConfig | None, Field(description="Certificates for a tls:// scheduler.")] = None

    @field_validator("scheduler")
    @classmethod
    def _an_address(cls, value: str | SchedulerConfig) -> str | SchedulerConfig:
        if isinstance(value, str):
            require_address(value)
        return value

    @property
    def slurm(self) -> SlurmConfig | None:
        """Options of SLURM jobs, if there are any."""
        return self.scheduler.slurm if isinstance(self.scheduler, SchedulerConfig) else None


def require_address(text: str) -> None:
    """Refuse what is no scheduler.

    Raises
    ------
    ValueError
        If it is none.
    """
    if text not in ("local", "slurm") and not re.fullmatch(r"(tcp|tls)://\S+:\d+", text):
        raise ValueError(f"'{text}' is not local, slurm, tcp://HOST:PORT or tls://HOST:PORT")
