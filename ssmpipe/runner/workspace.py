"""The output folder of a run, and what stands in it: where a task writes, what it would read, whether it is up to date."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ssmpipe.core.errors import SsmpipeError
from ssmpipe.runner.fingerprint import digest
from ssmpipe.runner.manifest import Decision, Manifest, Request, damaged_outputs, decide, read_manifest
from ssmpipe.runner.plan import CHAIN, SCAN, Plan, PlannedStep, Producer
from ssmpipe.runner.registry import Registry
from ssmpipe.runner.sources import Source

if TYPE_CHECKING:
    from ssmpipe.runner.project import Project

PREPARE = "prepare"
SCRATCH = ".work"


class NotMadeYetError(SsmpipeError):
    """An input of a task does not exist (yet)."""


@dataclass(frozen=True)
class Workspace:
    """All that a task needs to find its inputs; plain data, sent to child processes.

    Parameters
    ----------
    out : Path
    plan : Plan
    sources : dict of Source
        Of the shapes that this workspace is about.
    seed : int
    registry : Registry
    scratch : Path
        Folder on the same disk for what is not finished.
    joins : bool
        Whether the shapes join a finished model, whose chain stays as it is.
    """

    out: Path
    plan: Plan
    sources: Mapping[str, Source]
    seed: int
    registry: Registry
    scratch: Path
    joins: bool = False
    cache: dict[Path, Manifest | None] = field(default_factory=dict, compare=False)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "cache": {}}

    @property
    def unit(self) -> str:
        """Unit of lengths: "mm", or "file units" where the config says ``units: none``."""
        return "file units" if any(source.units == "none" for source in self.sources.values()) else "mm"

    def only(self, ids: Iterable[str]) -> Workspace:
        """Return the same workspace with fewer shapes."""
        return replace(self, sources={i: self.sources[i] for i in ids}, cache={})

    def folder(self, step: PlannedStep, shape: str | None) -> Path:
        """Folder of a task's outputs: per shape and stage, or per group stage."""
        if shape is not None:
            return self.out / "shapes" / shape / step.folder
        return self.out / "cohort" / step.id

    def prepared_folder(self, step: PlannedStep) -> Path:
        """Folder of what a stage prepares once for all shapes."""
        return self.out / "cohort" / f"{step.folder}-{PREPARE}"

    def manifest(self, folder: Path) -> Manifest | None:
        """Return the manifest of a folder, read once."""
        if folder not in self.cache:
            self.cache[folder] = read_manifest(folder)
        return self.cache[folder]

    def forget(self) -> None:
        """Drop remembered manifests, after other processes may have written."""
        self.cache.clear()

    def produced(self, producer: Producer, shape: str | None) -> tuple[Path, Manifest | None]:
        """Return the folder and manifest of whoever makes a slot."""
        step = self.plan.step(producer.step)
        if producer.prepared:
            folder = self.prepared_folder(step)
        else:
            folder = self.folder(step, None if producer.scope == "cohort" else shape)
        return folder, self.manifest(folder)

    def slot_digest(self, producer: Producer, slot: str, shape: str | None) -> str:
        """Return the content digest of one artifact.

        Raises
        ------
        NotMadeYetError
            If it does not exist.
        """
        if producer.step == SCAN:
            return self.sources[str(shape)].digest(slot, producer.columns)
        if producer.step == CHAIN:
            return self._chain_digest()
        _, manifest = self.produced(producer, shape)
        if manifest is None:
            what = f"'{slot}' of stage '{producer.step}'"
            raise NotMadeYetError(
                f"{what} has not been made yet", f"run it first: ssmpipe run ... --from {producer.step}"
            )
        return manifest.outputs[slot].digest if slot in manifest.outputs else "absent"

    def _chain_digest(self) -> str:
        """Return the digest of the chain up to the correspondence, and of what its steps prepared."""
        from ssmpipe.runner.chain import chain_content, chain_steps

        prepared = {}
        for step in chain_steps(self.plan):
            for port in step.prepared:
                if port.slot in step.files:
                    prepared[f"{step.id}.{port.slot}"] = step.files[port.slot][0]
                else:
                    prepared[f"{step.id}.{port.slot}"] = self.slot_digest(
                        Producer(step.id, "cohort", prepared=True), port.slot, None
                    )
        return digest(["chain", chain_content(self), prepared])

    def input_digests(self, step: PlannedStep, shape: str | None, ids: Sequence[str]) -> dict[str, str | None]:
        """Return the digest of every input of a task; a group stage's per-shape inputs count with their shape ids."""
        digests: dict[str, str | None] = {}
        for slot, producer in step.inputs.items():
            if producer is None:
                digests[slot] = None
            elif producer.prepared and slot in step.files:
                digests[slot] = digest(["file", step.files[slot][0]])
            elif shape is None and producer.scope == "shape":
                digests[slot] = digest([[i, self.slot_digest(producer, slot, i)] for i in sorted(ids)])
            else:
                digests[slot] = self.slot_digest(producer, slot, shape)
        return digests

    def prepare_digests(self, step: PlannedStep, ids: Sequence[str]) -> dict[str, str | None]:
        """Return the digests of the per-shape inputs that the common ones are made from."""
        return {
            slot: digest([[i, self.slot_digest(producer, slot, i)] for i in sorted(ids)])
            for slot, producer in step.inputs.items()
            if producer is not None and not producer.prepared and producer.scope == "shape"
        }

    def request(
        self, step: PlannedStep, shape: str | None, ids: Sequence[str] = (), *, prepare: bool = False
    ) -> Request:
        """Return what a task would be run with now."""
        inputs = self.prepare_digests(step, ids) if prepare else self.input_digests(step, shape, ids)
        return Request(step.stage, step.version, dict(step.options), inputs, self.seed, shape)

    def decision(
        self,
        step: PlannedStep,
        shape: str | None,
        ids: Sequence[str] = (),
        *,
        prepare: bool = False,
        force: bool = False,
    ) -> Decision:
        """Return whether a task has to run, and why."""
        folder = self.prepared_folder(step) if prepare else self.folder(step, shape)
        return decide(self.manifest(folder), self.request(step, shape, ids, prepare=prepare), folder, force=force)

    def prepared_is_usable(self, step: PlannedStep) -> bool:
        """Whether what was prepared for all shapes is there, intact, and made with the present options."""
        folder = self.prepared_folder(step)
        manifest = self.manifest(folder)
        if manifest is None or damaged_outputs(manifest, folder):
            return False
        old = manifest.request
        return (old.version, old.config, old.seed) == (step.version, dict(step.options), self.seed)


@dataclass(frozen=True)
class Forecast:
    """What would happen to a task if a run started now; ``shape`` is "" for group tasks and "*" for preparations.

    Not ``certain``: its own request is as before, but a task before it would run, and may give something else.
    """

    step: str
    shape: str
    run: bool
    reason: str
    certain: bool = True


def forecast(
    workspace: Workspace,
    selected: Sequence[PlannedStep],
    ids: Sequence[str],
    forced: Iterable[str] = (),
    ready: Iterable[str] = (),
    stops: Mapping[str, int] | None = None,
) -> list[Forecast]:
    """Say for every task whether it would run and why, without running anything.

    A task behind one that would run is foreseen to run as well ("input may change"); in the run itself it is spared when
    the new input turns out to be the same. The preparations of the steps in ``ready`` count as done. A shape in ``stops``
    does not come through the step of that number: it takes part in what is before, and in the preparation of that step.
    """
    done, ends = set(ready), stops or {}
    chosen, force = {step.id for step in selected}, set(forced)
    pending: set[tuple[str, str]] = set()
    found: list[Forecast] = []

    def judge(step: PlannedStep, key: str, members: Sequence[str], *, prepare: bool = False) -> None:
        shape = None if key in ("", "*") else key
        certain = True
        waits = []
        for slot, producer in step.inputs.items():
            if producer is None or producer.step in (SCAN, CHAIN) or (prepare and producer.prepared):
                continue
            if slot in step.files:
                continue
            if producer.prepared:
                keys = [(producer.step, "*")]
            elif producer.scope == "cohort":
                keys = [(producer.step, "")]
            else:
                keys = [(producer.step, m) for m in ([shape] if shape else members)]
            if any(k in pending for k in keys):
                waits.append(f"{slot} (from {producer.step})")
        if waits:
            folder = workspace.prepared_folder(step) if prepare else workspace.folder(step, shape)
            old = workspace.manifest(folder)
            request = Request(
                step.stage, step.version, dict(step.options), old.request.inputs if old else {}, workspace.seed
            )
            decision = decide(old, request, folder, force=step.id in force)
            if not decision.run:
                certain, decision = False, Decision(True, f"input may change: {', '.join(waits)}")
        else:
            try:
                decision = workspace.decision(step, shape, members, prepare=prepare, force=step.id in force)
            except SsmpipeError as error:
                decision = Decision(True, str(error))
        if decision.run:
            pending.add((step.id, key))
        found.append(Forecast(step.id, key, decision.run, decision.reason, certain))

    for step in workspace.plan.steps:
        if step.id not in chosen:
            continue
        if step.scope == "cohort":
            judge(step, "", [i for i in ids if i not in ends])
            continue
        if step.prepares and step.id not in done:
            reached = [i for i in ids if step.number <= ends.get(i, step.number)]
            judge(step, "*", prepare_members(step, reached), prepare=True)
        for shape in ids:
            if step.number < ends.get(shape, step.number + 1):
                judge(step, shape, ids)
    return found


def prepare_members(step: PlannedStep, ids: Sequence[str]) -> list[str]:
    """Return the shapes that the common inputs of a step are made from: one when an option names it, else all."""
    for port in step.prepared:
        named = step.options.get(port.slot)
        if named in ids:
            return [str(named)]
    return list(ids)


def make_workspace(project: Project, part: tuple[int, int] | None = None) -> Workspace:
    """Return the workspace of a project's output folder; ``part`` (i, N) of a run has a scratch folder of its own."""
    scratch = project.out / SCRATCH
    if part is not None:
        scratch = scratch / f"part-{part[0]}-of-{part[1]}"
    return Workspace(project.out, project.plan, project.sources, project.config.seed, project.registry, scratch)
