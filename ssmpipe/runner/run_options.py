"""What the command line of ``run`` says: what is to be run, and where."""

from __future__ import annotations

from dataclasses import dataclass

from ssmpipe.core.errors import ConfigError
from ssmpipe.runner.config import RunConfig, require_address


@dataclass(frozen=True)
class RunOptions:
    """What the command line of ``run`` says; ``forced`` is a set of step ids, or ``{"*"}`` for all."""

    first: str | None = None
    last: str | None = None
    only: tuple[str, ...] = ()
    shapes: tuple[str, ...] = ()
    forced: frozenset[str] = frozenset()
    jobs: int | None = None
    part: tuple[int, int] | None = None
    executor: str | None = None
    scheduler: str | None = None


def scheduler_of(config: RunConfig, options: RunOptions) -> str | None:
    """Return the scheduler of a run, the command line before the config; None for processes of this machine.

    Raises
    ------
    ConfigError
        If a scheduler is named that would not be used, or the name is none.
    """
    executor = options.executor or config.executor
    if executor == "local":
        if options.scheduler is not None:
            raise ConfigError("--scheduler is used with --executor dask only", "add --executor dask")
        return None
    if options.scheduler is None:
        return config.scheduler if isinstance(config.scheduler, str) else "slurm"
    try:
        require_address(options.scheduler)
    except ValueError as error:
        raise ConfigError(f"--scheduler: {error}") from None
    return options.scheduler
