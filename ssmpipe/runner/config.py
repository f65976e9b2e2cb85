"""Config file to a checked project: every problem at once, with file, line and a suggestion, before anything runs."""

from __future__ import annotations

import copy
import json
import os
import re
import types
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from ssmpipe.contract import NamesShape, Stage
from ssmpipe.core.errors import ConfigError, SsmpipeError
from ssmpipe.runner.advice import advise
from ssmpipe.runner.document import Document, Loc, parse_value, read_document
from ssmpipe.runner.fingerprint import file_digest
from ssmpipe.runner.plan import Plan, PlanError, Step, make_plan
from ssmpipe.runner.presets import PRESETS, find_preset
from ssmpipe.runner.registry import RESERVED, Registry
from ssmpipe.runner.sources import (
    ID,
    IMAGE_SUFFIXES,
    KINDS,
    OUTLINE_SUFFIXES,
    SPLINE_SUFFIX,
    Source,
    by_id,
    find_sources,
    scan_files,
)
from ssmpipe.runner.suggest import count, did_you_mean


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


class ConfigErrors(ConfigError):
    """All problems of a config file, one line each."""

    def __init__(self, problems: Sequence[str]) -> None:
        self.problems = tuple(problems)
        super().__init__("\n".join(problems))

    def __reduce__(self) -> tuple[type, tuple[Any, ...]]:
        return (ConfigErrors, (self.problems,))


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


@dataclass(frozen=True)
class _Entry:
    """A step while it is put together; ``loc`` is its place in the document, if it has one."""

    id: str
    stage: str
    options: dict[str, Any]
    sources: dict[str, str]
    loc: Loc


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
        _override(document, text)
    problems: list[str] = []
    config = _validated(RunConfig, document.data, (), document, problems)
    entries = _chain(document, registry, problems)
    if not entries and not problems:
        problems.append(
            f"{document.where(('stages',))}: stages: the chain is empty; set anatomy: {' | '.join(PRESETS)}, or list stages"
        )
    planar = any(entry.stage == "contour" for entry in entries)
    later: list[str] = []  # problems of the inputs come after those of the stages
    section = config.input if config is not None else _usable_input(document)
    sources, warnings = _sources(section, document, base, later, planar=planar, complete=config is not None)
    kinds = dict(sources[0].kinds) if sources else {}
    mixed = sorted({s.kind for s in sources})
    if len(mixed) > 1:
        later.append(
            f"{document.where(('input', 'scans'))}: input.scans: {' and '.join(mixed)} files cannot be mixed in one cohort"
        )
    available = set(kinds)
    if not kinds or mixed == ["spline"]:  # splines skip the stages before, whose options are checked all the same
        available |= set(KINDS["image" if planar and _pictures(section.scans) else "outline" if planar else "mesh"])
    prepared: list[Step] = []
    for entry in entries:
        step = _step(entry, available, document, registry, base, problems, ids={s.id for s in sources})
        if step is not None:
            prepared.append(step)
            available |= {port.slot for port in step.stage.outputs}
    problems += later
    if kinds and not problems:
        prepared = _enter(prepared, kinds)
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
    config: RunConfig, plan: Plan, document: Document, entries: Sequence[_Entry], sources: Sequence[Source]
) -> list[str]:
    """Return a warning for what the chain leaves out of account."""
    places = {entry.id: entry.loc for entry in entries}
    remarks = advise(plan, [source.side for source in sources], config.input.roles)
    return [f"{document.where(places[step])}: {step}: {text}" for step, text in remarks]


def _unknown_shapes(
    stage: Stage, options: Mapping[str, Any], files: Mapping[str, Any], at: Loc, ids: set[str], document: Document
) -> list[str]:
    """Return a problem for every option of a stage that names a shape which does not exist."""
    found = []
    for name, value in options.items():
        field = stage.config.model_fields.get(name)
        for mark in field.metadata if field is not None else ():
            if isinstance(mark, NamesShape) and isinstance(value, str) and name not in files:
                known = ids | set(mark.words)
                kind = "shape or file" if any(port.slot == name for port in stage.prepared) else "shape"
                if value not in known:
                    found.append(
                        f"{document.where((*at, name))}: {'.'.join(map(str, (*at, name)))}: there is no {kind} '{value}'"
                        f"{did_you_mean(value, known)}"
                    )
    return found


def _idle_roles(config: RunConfig, plan: Plan, document: Document, registry: Registry) -> list[str]:
    """Return a warning for every role that no stage of the chain reads: misspelled, or meant for another chain."""
    known = {role for step in plan.steps for role in registry.load(step.stage).roles}
    return [
        f"{document.where(('input', 'roles', role))}: input.roles.{role}: no stage of this chain reads it"
        f"{did_you_mean(role, known)}"
        for role in config.input.roles
        if role not in known
    ]


# --- the document --------------------------------------------------------------------------------------------------


_PATHS = (("input", "scans"), ("input", "cohort"), ("input", "landmarks"), ("output",))


def _override(document: Document, text: str) -> None:
    key, sep, raw = text.partition("=")
    parts = key.strip().split(".")
    if not sep or not all(parts):
        raise ConfigError(f"--set {text}: write it as key.path=value, for example --set seed=1")
    value = parse_value(raw)
    if tuple(parts) in _PATHS:
        value = [_absolute(v) for v in value] if isinstance(value, list) else _absolute(value)
    loc: Loc
    if parts[0] == "stages":
        loc = _override_stage(document, parts[1:], value, text)
    else:
        node = document.data
        for part in parts[:-1]:
            child = node.setdefault(part, {})
            if not isinstance(child, dict):
                raise ConfigError(f"--set {text}: '{part}' is not a section")
            node = child
        node[parts[-1]] = value
        loc = tuple(parts)
    document.overrides[loc] = text


def _override_stage(document: Document, parts: list[str], value: Any, text: str) -> Loc:
    if len(parts) < 2:
        raise ConfigError(f"--set {text}: name a stage and an option: stages.<stage>.<option>=value")
    stages = document.data.setdefault("stages", [])
    if not isinstance(stages, list):
        raise ConfigError(f"{document.where(('stages',))}: stages: must be a list")
    for i, entry in enumerate(stages):
        if entry == parts[0]:
            stages[i] = entry = {parts[0]: {}}
        if isinstance(entry, dict) and len(entry) == 1:
            name, options = next(iter(entry.items()))
            given = options.get("id", name) if isinstance(options, dict) else name
            if parts[0] == given:
                place, at = entry, (("stages", i, name))
                break
    else:
        place, at, name = {parts[0]: {}}, ("stages", len(stages), parts[0]), parts[0]
        stages.append(place)
        document.overrides[at[:2]] = text
    node = place
    for part in [name, *parts[1:-1]]:
        if node.get(part) is None:
            node[part] = {}
        node = node[part]
        if not isinstance(node, dict):
            raise ConfigError(f"--set {text}: '{part}' has no options")
    if isinstance(value, str) and value.count(".") and Path(value).is_file():
        value = _absolute(value)
    node[parts[-1]] = value
    return (*at, *parts[1:])


def _absolute(value: Any) -> Any:
    return str(Path.cwd() / value) if isinstance(value, str) else value


# --- validation ----------------------------------------------------------------------------------------------------


def _validated(model: type[BaseModel], data: Any, at: Loc, document: Document, problems: list[str]) -> Any:
    try:
        return model.model_validate_json(json.dumps(data))
    except ValidationError as error:
        for loc, text in explain(error, model, data):
            full = (*at, *loc)
            shown = ".".join(str(part) for part in full)
            problems.append(f"{document.where(full)}: {shown}: {text}" if shown else f"{document.where(full)}: {text}")
        return None


def explain(error: ValidationError, model: type[BaseModel], data: Any) -> list[tuple[Loc, str]]:
    """Turn pydantic's errors into (path, one line) pairs, those of a union's branches joined."""
    grouped: dict[Loc, list[str]] = {}
    tails: dict[Loc, str] = {}
    for item in error.errors(include_url=False):
        loc, value = _existing(item["loc"], data)
        kind = item["type"]
        if kind == "extra_forbidden":
            texts, tail = ["unknown key"], did_you_mean(str(item["loc"][-1]), _known_keys(model, item["loc"][:-1]))
        elif kind == "missing":
            loc, texts, tail = tuple(item["loc"]), ["is missing"], ""
        else:
            message = item["msg"].removeprefix("Value error, ").removeprefix("Input ").strip()
            shown = json.dumps(value, ensure_ascii=False)
            texts, tail = [message], f" (got {shown if len(shown) <= 80 else shown[:77] + '...'})"
        for text in texts:
            if text not in grouped.setdefault(loc, []):
                grouped[loc].append(text)
        tails[loc] = tail
    return [(loc, " or ".join(texts) + tails[loc]) for loc, texts in grouped.items()]


def _existing(loc: Iterable[Any], data: Any) -> tuple[Loc, Any]:
    """Cut the tags of union branches off a pydantic location: keep the part that exists in the data."""
    kept: list[Any] = []
    for part in loc:
        if (isinstance(data, dict) and part in data) or (
            isinstance(data, list) and isinstance(part, int) and part < len(data)
        ):
            data = data[part]
            kept.append(part)
        elif not isinstance(data, dict | list):
            break
    return tuple(kept), data


def _known_keys(model: Any, loc: Sequence[Any]) -> list[str]:
    for part in loc:
        fields = getattr(model, "model_fields", None)
        if fields is None or part not in fields:
            return []
        model = _model_of(fields[part].annotation)
    return list(getattr(model, "model_fields", {}))


def _model_of(annotation: Any) -> Any:
    if get_origin(annotation) in (Union, types.UnionType, Annotated):
        return next((a for a in get_args(annotation) if hasattr(a, "model_fields")), None)
    return annotation


# --- the chain -----------------------------------------------------------------------------------------------------


def _chain(document: Document, registry: Registry, problems: list[str]) -> list[_Entry]:
    given = _entries(document, registry, problems)
    anatomy = document.data.get("anatomy")
    if anatomy is None:
        chain: list[_Entry] = []
        for entry, extra in given:
            if "after" in extra:
                problems.append(f"{document.where(entry.loc)}: {entry.id}: `after` needs an anatomy to insert into")
            if any(other.id == entry.id for other in chain):
                problems.append(
                    f"{document.where(entry.loc)}: stages: '{entry.id}' occurs twice; tell them apart: "
                    f"{entry.stage}: {{id: {entry.stage}-2}}"
                )
            elif not extra.get("skip"):
                chain.append(entry)
        return chain
    where = document.where(("anatomy",))
    try:
        preset = find_preset(str(anatomy))
    except ConfigError as error:
        problems.append(f"{where}: anatomy: {error.fact.replace('unknown anatomy', 'unknown')}")
        return []
    chain = [_Entry(name, name, copy.deepcopy(dict(options)), {}, ("anatomy",)) for name, options in preset.stages]
    seen: dict[str, Loc] = {}
    for entry, extra in given:
        line = document.where(entry.loc)
        if entry.id in seen:
            problems.append(f"{line}: stages: '{entry.id}' is given twice, first in {document.where(seen[entry.id])}")
            continue
        seen[entry.id] = entry.loc
        at = next((i for i, step in enumerate(chain) if step.id == entry.id), None)
        if at is not None and "after" in extra:
            problems.append(
                f"{line}: stages: '{entry.id}' is in the chain already; give the second one an id: "
                f"{entry.stage}: {{id: {entry.stage}-2, after: {extra['after']}}}"
            )
        elif at is not None and extra.get("skip"):
            del chain[at]
        elif at is not None:
            old = chain[at]
            chain[at] = _Entry(old.id, old.stage, {**old.options, **entry.options}, entry.sources, entry.loc)
        elif "after" in extra:
            place = next((i for i, step in enumerate(chain) if step.id == extra["after"]), None)
            if place is None:
                problems.append(
                    f"{line}: {entry.id}.after: no such step '{extra['after']}'"
                    f"{did_you_mean(str(extra['after']), [s.id for s in chain])}"
                )
            else:
                chain.insert(place + 1, entry)
        elif not extra.get("skip"):
            problems.append(
                f"{line}: stages: '{entry.id}' is not part of the chain of {preset.name}; say where it goes "
                f"({entry.stage}: {{after: {chain[0].id if chain else 'repair'}}}), or leave out anatomy and list all stages"
            )
    return chain


def _entries(document: Document, registry: Registry, problems: list[str]) -> list[tuple[_Entry, dict[str, Any]]]:
    stages = document.data.get("stages") or []
    if not isinstance(stages, list):
        return []
    found = []
    for i, item in enumerate(stages):
        where = document.where(("stages", i))
        if isinstance(item, str):
            item = {item: None}
        if not isinstance(item, dict) or len(item) != 1:
            problems.append(f"{where}: stages.{i}: write one stage per entry: - decimate: {{n_faces: 10000}}")
            continue
        name, options = next(iter(item.items()))
        loc: Loc = ("stages", i, name)
        if name not in registry.names():
            problems.append(
                f"{document.where(loc)}: stages.{i}: unknown stage '{name}'{did_you_mean(name, registry.names())}"
            )
            continue
        if options is not None and not isinstance(options, dict):
            problems.append(
                f"{document.where(loc)}: {name}: needs options as a mapping (got {json.dumps(options)[:60]})"
            )
            continue
        options = dict(options or {})
        extra = {key: options.pop(key) for key in RESERVED if key in options}
        problem = _check_reserved(extra)
        if problem:
            problems.append(f"{document.where((*loc, problem[0]))}: {name}.{problem[0]}: {problem[1]}")
            continue
        found.append((_Entry(str(extra.get("id", name)), name, options, dict(extra.get("from") or {}), loc), extra))
    return found


def _check_reserved(extra: Mapping[str, Any]) -> tuple[str, str] | None:
    for key, value in extra.items():
        if key == "skip" and not isinstance(value, bool):
            return key, f"must be true or false (got {json.dumps(value)})"
        if key in ("id", "after") and not (isinstance(value, str) and ID.fullmatch(value) and "." not in value):
            return key, f"must be a short name of letters, digits, '_' and '-' (got {json.dumps(value)})"
        if key == "from" and not (isinstance(value, dict) and all(isinstance(v, str) for v in value.values())):
            return key, f"must say which step each slot comes from, like {{mesh: repair}} (got {json.dumps(value)})"
    return None


def _step(
    entry: _Entry,
    available: set[str],
    document: Document,
    registry: Registry,
    base: Path,
    problems: list[str],
    ids: set[str],
) -> Step | None:
    try:
        stage = registry.load(entry.stage).suiting(available)
    except ConfigError as error:
        problems.append(f"{document.where(entry.loc)}: {error}")
        return None
    found = len(problems)
    options = dict(entry.options)
    files = _prepared_files(stage, options, base)
    at = entry.loc if entry.loc != ("anatomy",) else ("stages", entry.id)
    config = _validated(stage.config, options, at, document, problems)
    if ids:
        problems += _unknown_shapes(stage, options, files, at, ids, document)
    for slot in entry.sources:
        if slot not in {port.slot for port in stage.inputs}:
            problems.append(
                f"{document.where((*entry.loc, 'from', slot))}: {entry.id}.from.{slot}: {stage.name} reads no such slot"
                f"{did_you_mean(slot, [port.slot for port in stage.inputs])}"
            )
    if config is None or len(problems) > found:
        return None
    resolved = config.model_dump(mode="json")
    for slot, (sha, _) in files.items():
        resolved[slot] = f"file:{sha}"  # the content counts, not where it lies
    return Step(entry.id, stage, resolved, dict(entry.sources), files)


def _prepared_files(stage: Stage, options: dict[str, Any], base: Path) -> dict[str, tuple[str, str]]:
    """Return the prepared slots whose option of the same name is a file: its digest and path."""
    files = {}
    for port in stage.prepared:
        value = options.get(port.slot)
        if isinstance(value, str) and (base / value).is_file():
            path = (base / value).resolve()
            files[port.slot] = (file_digest(path), str(path))
    return files


def variant_stages(names: Sequence[str], available: Iterable[str], registry: Registry) -> dict[str, Stage]:
    """Return the stages of a chain by name, in the variant that suits what the scans and the stages before it provide."""
    slots, found = set(available), {}
    for name in names:
        found[name] = registry.load(name).suiting(slots)
        slots |= {port.slot for port in found[name].outputs}
    return found


def _enter(steps: list[Step], kinds: Mapping[str, str]) -> list[Step]:
    """Let splines enter where the first surface is read: the per-shape steps before it have nothing to do."""
    if "surface" not in kinds:
        return steps
    first = next((i for i, s in enumerate(steps) if any(p.slot == "surface" for p in s.stage.inputs)), 0)
    return steps[first:]


# --- the inputs ----------------------------------------------------------------------------------------------------


def _pictures(scans: str | list[str] | None) -> bool:
    """Whether the names of the scans, found or not, are those of pictures."""
    given = scans if isinstance(scans, list) else [scans or ""]
    return any(Path(pattern).suffix.lower() in IMAGE_SUFFIXES for pattern in given)


def _usable_input(document: Document) -> InputConfig:
    """Return what can be read of a section `input` with problems, so that missing files are named together with them."""
    data = document.data.get("input")
    usable = {}
    for key, value in data.items() if isinstance(data, dict) else ():
        try:
            InputConfig.model_validate_json(json.dumps({key: value}))
        except ValidationError:
            continue
        usable[key] = value
    return InputConfig.model_validate_json(json.dumps(usable))


def _sources(
    section: InputConfig, document: Document, base: Path, problems: list[str], *, planar: bool, complete: bool
) -> tuple[list[Source], list[str]]:
    """Find the scans and read the tables; problems of all of them are noted, not only the first one's."""
    from ssmpipe.io.landmarks import read_landmarks
    from ssmpipe.io.meshes import MESH_SUFFIXES
    from ssmpipe.io.tables import read_cohort

    in_folders = (*((*OUTLINE_SUFFIXES, *IMAGE_SUFFIXES) if planar else MESH_SUFFIXES), SPLINE_SUFFIX)
    known = (*MESH_SUFFIXES, *OUTLINE_SUFFIXES, *IMAGE_SUFFIXES, SPLINE_SUFFIX)
    found = len(problems)

    def note(error: SsmpipeError | str, *at: str) -> None:
        loc = ("input", *at)
        problems.append(f"{document.where(loc)}: {'.'.join(loc)}: {error}")

    tables: dict[str, Any] = {"cohort": None, "landmarks": None}
    for key, read in (("cohort", read_cohort), ("landmarks", read_landmarks)):
        try:
            if getattr(section, key) is not None:
                tables[key] = read(base / getattr(section, key))
        except SsmpipeError as error:
            note(error, key)
    if section.roles and section.landmarks is None and complete:
        note("names landmarks, but input.landmarks is not set", "roles")
    given = section.scans if isinstance(section.scans, list) else [section.scans] if section.scans is not None else []
    no_scans = {(base / p).resolve() for p in (section.cohort, section.landmarks) if p}
    paths: dict[Path, None] = {}
    for pattern in given:
        try:
            paths |= dict.fromkeys(p for p in scan_files([base / pattern], in_folders) if p.resolve() not in no_scans)
        except ConfigError as error:
            note(error, "scans")
    try:
        if section.scans is not None:
            files = by_id(list(paths))
        elif tables["cohort"] and section.cohort:
            files = _cohort_files(tables["cohort"], base / section.cohort, base)
        else:
            files = {}
        if not files and complete and len(problems) == found:
            raise ConfigError("no scans given", "set input.scans, or give the cohort table a column 'path'")
        strange = sorted(p.name for p in files.values() if p.suffix.lower() not in known)
        if strange:
            raise ConfigError(f"{strange[0]} is not a surface file", f"supported are {' '.join(known)}")
    except ConfigError as error:
        note(error, "scans")
    if len(problems) > found or not files:
        return [], []
    anatomy = document.data.get("anatomy")
    preset = PRESETS.get(anatomy) if isinstance(anatomy, str) else None
    try:
        sources, warnings = find_sources(
            files,
            cohort=tables["cohort"],
            landmarks=tables["landmarks"],
            units=section.units,
            roles=dict(section.roles),
            diagonal_mm=preset.diagonal_mm if preset else None,
            anatomy=anatomy or "",
            tolerance_mm=section.landmark_tolerance,
        )
    except ConfigError as error:
        note(error, "scans")
        return [], []
    names = {name for source in sources for name in source.landmarks or {}}
    for role, name in section.roles.items():
        if tables["landmarks"] is not None and name not in names:
            note(f"no shape has a landmark '{name}'{did_you_mean(name, names)}", "roles", role)
    return sources, warnings


def _cohort_files(cohort: Mapping[str, Mapping[str, str]], path: Path, base: Path) -> dict[str, Path]:
    """Return the scans that a cohort table names; a table may come from elsewhere, so it may not lead out of the folders."""
    files: dict[str, Path] = {}
    missing = []
    roots = [Path(os.path.abspath(folder)) for folder in (path.parent, base)]
    for shape_id, row in cohort.items():
        if not row.get("path"):
            continue
        if not ID.fullmatch(shape_id):
            raise ConfigError(f"'{shape_id}' cannot serve as shape id", "use up to 64 letters, digits, '.', '_' or '-'")
        files[shape_id] = path.parent / row["path"]
        place = Path(os.path.abspath(files[shape_id]))
        if "\0" in row["path"] or not any(place.is_relative_to(root) for root in roots):
            raise ConfigError(
                f"cohort table, shape '{shape_id}': path '{row['path']}' leads out of the folders of table and config",
                "keep the table above the scans, or name the folder of the scans as input.scans",
            )
        if not files[shape_id].is_file():
            missing.append(f"{files[shape_id]} (shape '{shape_id}')")
    if missing:
        raise ConfigError(
            f"cohort table: {count(len(missing), 'scan')} missing: {', '.join(missing)}", "check the column path"
        )
    return files
