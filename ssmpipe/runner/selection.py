"""The steps and shapes of a run, by the names that the command line gives."""

from __future__ import annotations

from dataclasses import dataclass

from ssmpipe.core.errors import ConfigError
from ssmpipe.runner.plan import PlannedStep, select
from ssmpipe.runner.project import Project
from ssmpipe.runner.run_options import RunOptions
from ssmpipe.runner.suggest import did_you_mean


@dataclass(frozen=True)
class Selection:
    """Steps and shapes of a run; ``partial`` when not all shapes are in it, and group stages therefore are not run."""

    steps: tuple[PlannedStep, ...]
    shapes: tuple[str, ...]
    forced: frozenset[str]
    partial: bool
    dropped: tuple[str, ...]


def make_selection(project: Project, options: RunOptions) -> Selection:
    """Check names and select steps and shapes.

    Raises
    ------
    ConfigError
        If a step or shape does not exist, or options contradict each other.
    """
    names = [step.id for step in project.plan.steps]
    asked = [n for n in (options.first, options.last, *options.only, *options.forced) if n and n != "*"]
    for name in asked:
        if name not in names:
            raise ConfigError(f"there is no stage '{name}' in this chain{did_you_mean(name, names)}")
    if options.only and (options.first or options.last):
        raise ConfigError("--only cannot be combined with --from and --to")
    steps = select(project.plan, first=options.first, last=options.last, only=options.only)
    if not steps:
        raise ConfigError(f"--from {options.first} --to {options.last} selects no stage", "swap them")
    everyone = sorted(project.sources)
    for shape in options.shapes:
        if shape not in project.sources:
            raise ConfigError(f"there is no shape '{shape}'{did_you_mean(shape, everyone)}")
    shapes = [i for i in everyone if not options.shapes or i in options.shapes]
    if options.part is not None:
        number, total = options.part
        if not 1 <= number <= total:
            raise ConfigError(f"--part {number}/{total}: the first number must be between 1 and the second")
        shapes = shapes[number - 1 :: total]
    partial = options.part is not None or bool(options.shapes)
    dropped = tuple(step.id for step in steps if step.scope == "cohort") if partial else ()
    steps = tuple(step for step in steps if step.id not in dropped)
    if not steps:
        raise ConfigError("group stages need all shapes", "leave out --shape and --part")
    forced = frozenset(s.id for s in steps) if "*" in options.forced else options.forced
    return Selection(steps, tuple(shapes), forced, partial, dropped)
