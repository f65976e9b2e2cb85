"""Steps times shapes: which task reads what from whom. Pure; fails before any work starts."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from ssmpipe.contract import Port, Scope, Stage
from ssmpipe.core.errors import ConfigError

SCAN = "scan"  # the producer of what comes from the input files
CHAIN = "chain"  # the producer of the slot of the same name: the runner itself, which knows the chain


@dataclass(frozen=True)
class Step:
    """One entry of the chain: a stage with all its options filled in (plain JSON data).

    ``sources`` overrides which earlier step a slot is read from; ``files`` names the prepared slots that are read from a
    file instead of being made (file digest by slot, and its path).
    """

    id: str
    stage: Stage
    options: Mapping[str, Any] = field(default_factory=dict)
    sources: Mapping[str, str] = field(default_factory=dict)
    files: Mapping[str, tuple[str, str]] = field(default_factory=dict)


@dataclass(frozen=True)
class Producer:
    """Who makes a slot: a step (or the scan itself), once per shape or once for the cohort.

    ``columns`` are those of the cohort table that are read of a scan's ``info``; None for all.
    """

    step: str
    scope: Scope
    prepared: bool = False
    columns: tuple[str, ...] | None = None


@dataclass(frozen=True)
class PlannedStep:
    """A step with its place in the chain and its inputs resolved; plain data that a child process can receive."""

    number: int
    id: str
    stage: str
    scope: Scope
    version: int
    options: Mapping[str, Any]
    inputs: Mapping[str, Producer | None]
    kinds: Mapping[str, str]
    outputs: tuple[Port, ...]
    prepared: tuple[Port, ...] = ()
    files: Mapping[str, tuple[str, str]] = field(default_factory=dict)

    @property
    def folder(self) -> str:
        """Folder name inside a shape's folder: position and id."""
        return f"{self.number:02d}-{self.id}"

    @property
    def prepares(self) -> bool:
        """Whether something common to all shapes has to be made first."""
        return any(port.slot not in self.files for port in self.prepared)

    @property
    def upstream(self) -> list[Producer]:
        """Producers of the inputs, the scan and the runner left out."""
        return [p for p in self.inputs.values() if p is not None and p.step not in (SCAN, CHAIN)]


class PlanError(ConfigError):
    """The chain cannot work; ``problems`` are (step id, what) pairs."""

    def __init__(self, problems: Sequence[tuple[str, str]]) -> None:
        self.problems = tuple(problems)
        super().__init__("; ".join(text for _, text in problems))

    def __reduce__(self) -> tuple[type, tuple[Any, ...]]:
        return (PlanError, (self.problems,))


@dataclass(frozen=True)
class Plan:
    """The chain in order."""

    steps: tuple[PlannedStep, ...]

    def step(self, name: str) -> PlannedStep:
        """Return a step by id."""
        return next(step for step in self.steps if step.id == name)

    def tasks(self, ids: Sequence[str]) -> list[tuple[str, str]]:
        """Return (step, shape) in order of execution; the shape of a group task is ``""``, of a preparation ``"*"``."""
        tasks: list[tuple[str, str]] = []
        for kind, steps in segments(self.steps):
            if kind == "shape":
                tasks += [(step.id, shape) for shape in ids for step in steps]
            else:
                tasks.append((steps[0].id, "*" if kind == "prepare" else ""))
        return tasks


def make_plan(steps: Sequence[Step], source: Mapping[str, str]) -> Plan:
    """Resolve the inputs of every step: the newest producer of the slot before it.

    Parameters
    ----------
    steps : sequence of Step
    source : dict of str
        Slots that the scans provide, with their kinds.

    Raises
    ------
    PlanError
        If a required slot has no producer, or the producer makes another kind of artifact.
    """
    made: dict[str, list[tuple[Producer, str]]] = {
        slot: [(Producer(SCAN, "shape"), kind)] for slot, kind in source.items()
    }
    made[CHAIN] = [(Producer(CHAIN, "cohort"), CHAIN)]
    planned: list[PlannedStep] = []
    problems: list[tuple[str, str]] = []
    for number, step in enumerate(steps, start=1):
        stage = step.stage
        inputs: dict[str, Producer | None] = {}
        files = dict(step.files)
        ready = {port.slot: port.kind for port in stage.prepared}
        for port in stage.inputs:
            if port.slot in ready:
                inputs[port.slot] = Producer(step.id, "cohort", prepared=True)
                continue
            wanted = step.sources.get(port.slot)
            found = [(p, kind) for p, kind in made.get(port.slot, []) if wanted is None or p.step == wanted]
            if not found and (wanted is not None or not port.optional):
                problems.append((step.id, _missing(step, port, wanted, steps, number)))
            elif found and found[-1][1] != port.kind:
                (maker, kind) = found[-1]
                text = f"stage '{step.id}' reads '{port.slot}' as {port.kind}, but '{maker.step}' makes it as {kind}"
                problems.append((step.id, text))
            inputs[port.slot] = replace(found[-1][0], columns=port.columns) if found else None
            if found and found[-1][0].prepared:
                maker_step = next(p for p in planned if p.id == found[-1][0].step)
                files |= {port.slot: maker_step.files[port.slot]} if port.slot in maker_step.files else {}
        planned.append(
            PlannedStep(
                number=number,
                id=step.id,
                stage=stage.name,
                scope=stage.scope,
                version=stage.version,
                options=dict(step.options),
                inputs=inputs,
                kinds={port.slot: port.kind for port in stage.inputs},
                outputs=stage.outputs,
                prepared=stage.prepared,
                files=files,
            )
        )
        for port in stage.prepared:
            made.setdefault(port.slot, []).append((Producer(step.id, "cohort", prepared=True), port.kind))
        for port in stage.outputs:
            made.setdefault(port.slot, []).append((Producer(step.id, stage.scope), port.kind))
    if problems:
        raise PlanError(problems)
    return Plan(tuple(planned))


def _missing(step: Step, port: Port, wanted: str | None, steps: Sequence[Step], number: int) -> str:
    if wanted is not None:
        return f"stage '{step.id}' is to read '{port.slot}' from '{wanted}', which does not make it before"
    later = [s.id for s in steps[number:] if any(out.slot == port.slot for out in s.stage.outputs)]
    hint = f"; '{later[0]}' makes it, but comes later" if later else ""
    return f"stage '{step.id}' needs '{port.slot}', and no stage before it makes that{hint}"


Segment = tuple[Literal["shape", "prepare", "cohort"], list[PlannedStep]]


def segments(steps: Iterable[PlannedStep]) -> list[Segment]:
    """Cut the chain at its barriers: a group stage, or something that has to be prepared from all shapes.

    Consecutive per-shape steps stay together, so that one child process carries a shape through all of them.
    """
    parts: list[Segment] = []
    for step in steps:
        if step.scope == "cohort":
            parts.append(("cohort", [step]))
            continue
        if step.prepares:
            parts.append(("prepare", [step]))
        if parts and parts[-1][0] == "shape":
            parts[-1][1].append(step)
        else:
            parts.append(("shape", [step]))
    return parts


def select(
    plan: Plan, *, first: str | None = None, last: str | None = None, only: Sequence[str] = ()
) -> tuple[PlannedStep, ...]:
    """Return the steps from ``first`` to ``last``, or just those named in ``only``; names are checked by the caller."""
    if only:
        return tuple(step for step in plan.steps if step.id in only)
    start = plan.step(first).number if first else 1
    stop = plan.step(last).number if last else len(plan.steps)
    return tuple(step for step in plan.steps if start <= step.number <= stop)
