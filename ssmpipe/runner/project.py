"""Config file to a checked project: every problem at once, with file, line and a suggestion, before anything runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from ssmpipe.runner.advice import advise
from ssmpipe.runner.config import RunConfig
from ssmpipe.runner.config_input import are_pictures, input_sources, usable_input
from ssmpipe.runner.config_overrides import override
from ssmpipe.runner.config_problems import ConfigErrors, validated
from ssmpipe.runner.config_stages import Entry, chain_entries, checked_step, enter_at_splines
from ssmpipe.runner.document import Document, read_document
from ssmpipe.runner.plan import Plan, PlanError, Step, make_plan
from ssmpipe.runner.presets import PRESETS
from ssmpipe.runner.registry import Registry
from ssmpipe.runner.sources import KINDS, Source
from ssmpipe.runner.suggest import count, did_you_mean


@dataclass(frozen=True)
class Project:
    """A config with everything that follows from it, ready to run."""

    path: Path
    config: RunConfig
    out: Path
    steps: tuple[Step, ...]
    plan: Plan
    sources: Mapping[str, Source]
    warnings: tuple[str, ...]
    registry: Registry


def load_project(path: Path, overrides: Sequence[str] = (), registry: Registry | None = None) -> Project:
    """Read and check a config file and everything that it names, but open no scan.

    Parameters
    ----------
    path : Path
    overrides : sequence of str
        ``key.path=value`` from the command line; a stage is addressed by its name: ``stages.optimize.n_coefficients``.
    registry : Registry, optional

    Raises
    ------
    ConfigErrors
        With one line per problem: ``file:line: key.path: what (got ...); did you mean 'x'?``.
    """
    registry = registry or Registry.default()
    document = read_document(path)
    base = path.resolve().parent
    if document.data.get("stages", 0) is None:
        document.data["stages"] = []  # a bare `stages:` with everything below it commented out
    for text in overrides:
        override(document, text)
    problems: list[str] = []
    config = validated(RunConfig, document.data, (), document, problems)
    entries = chain_entries(document, registry, problems)
    if not entries and not problems:
        problems.append(
            f"{document.where(('stages',))}: stages: the chain is empty; set anatomy: {' | '.join(PRESETS)}, or list stages"
        )
    planar = any(entry.stage == "contour" for entry in entries)
    later: list[str] = []  # problems of the inputs come after those of the stages
    section = config.input if config is not None else usable_input(document)
    sources, warnings = input_sources(section, document, base, later, planar=planar, complete=config is not None)
    kinds = dict(sources[0].kinds) if sources else {}
    mixed = sorted({s.kind for s in sources})
    if len(mixed) > 1:
        later.append(
            f"{document.where(('input', 'scans'))}: input.scans: {' and '.join(mixed)} files cannot be mixed in one cohort"
        )
    available = set(kinds)
    if not kinds or mixed == ["spline"]:  # splines skip the stages before, whose options are checked all the same
        available |= set(KINDS["image" if planar and are_pictures(section.scans) else "outline" if planar else "mesh"])
    prepared: list[Step] = []
    for entry in entries:
        step = checked_step(entry, available, document, registry, base, problems, ids={s.id for s in sources})
        if step is not None:
            prepared.append(step)
            available |= {port.slot for port in step.stage.outputs}
    problems += later
    if kinds and not problems:
        prepared = enter_at_splines(prepared, kinds)
        try:
            plan = make_plan(prepared, kinds)
        except PlanError as error:
            places = {entry.id: entry.loc for entry in entries}
            problems += [f"{document.where(places[step])}: stages: {text}" for step, text in error.problems]
    if problems or config is None:
        raise ConfigErrors(problems)
    return Project(
        path=path.resolve(),
        config=config,
        out=(base / config.output).resolve(),
        steps=tuple(prepared),
        plan=plan,
        sources={source.id: source for source in sources},
        warnings=(
            *warnings,
            *_too_few(config, plan, document, len(sources)),
            *_idle_roles(config, plan, document, registry),
            *_advice(config, plan, document, entries, sources),
        ),
        registry=registry,
    )


def _too_few(config: RunConfig, plan: Plan, document: Document, n: int) -> list[str]:
    """Return a warning when the group stages will not be run for want of scans."""
    blocked = [step.id for step in plan.steps if step.scope == "cohort"]
    if n >= config.min_shapes or not blocked:
        return []
    return [
        f"{document.where(('input', 'scans'))}: input.scans: {count(n, 'scan')}, but group stages need at least "
        f"{config.min_shapes} (min_shapes); {', '.join(blocked)} will not be run; add scans"
        + (", or lower min_shapes" if n >= 2 else "")
    ]


def _advice(
    config: RunConfig, plan: Plan, document: Document, entries: Sequence[Entry], sources: Sequence[Source]
) -> list[str]:
    """Return a warning for what the chain leaves out of account."""
    places = {entry.id: entry.loc for entry in entries}
    remarks = advise(plan, [source.side for source in sources], config.input.roles)
    return [f"{document.where(places[step])}: {step}: {text}" for step, text in remarks]


def _idle_roles(config: RunConfig, plan: Plan, document: Document, registry: Registry) -> list[str]:
    """Return a warning for every role that no stage of the chain reads: misspelled, or meant for another chain."""
    known = {role for step in plan.steps for role in registry.load(step.stage).roles}
    return [
        f"{document.where(('input', 'roles', role))}: input.roles.{role}: no stage of this chain reads it"
        f"{did_you_mean(role, known)}"
        for role in config.input.roles
        if role not in known
    ]
