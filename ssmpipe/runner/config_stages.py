"""The section ``stages`` of a config: merged into the chain of its preset, and made into steps with checked options."""

from __future__ import annotations

import copy
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ssmpipe.contract import NamesShape, Stage
from ssmpipe.core.errors import ConfigError
from ssmpipe.runner.config_problems import validated
from ssmpipe.runner.document import Document, Loc
from ssmpipe.runner.fingerprint import file_digest
from ssmpipe.runner.plan import Step
from ssmpipe.runner.presets import find_preset
from ssmpipe.runner.registry import RESERVED, Registry
from ssmpipe.runner.sources import ID
from ssmpipe.runner.suggest import did_you_mean


@dataclass(frozen=True)
class Entry:
    """A step while it is put together; ``loc`` is its place in the document, if it has one."""

    id: str
    stage: str
    options: dict[str, Any]
    sources: dict[str, str]
    loc: Loc


def chain_entries(document: Document, registry: Registry, problems: list[str]) -> list[Entry]:
    """Return the chain: that of the preset with what ``stages`` changes in it, or ``stages`` alone; ``problems`` gets what is wrong."""
    given = _entries(document, registry, problems)
    anatomy = document.data.get("anatomy")
    if anatomy is None:
        chain: list[Entry] = []
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
    chain = [Entry(name, name, copy.deepcopy(dict(options)), {}, ("anatomy",)) for name, options in preset.stages]
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
            chain[at] = Entry(old.id, old.stage, {**old.options, **entry.options}, entry.sources, entry.loc)
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


def _entries(document: Document, registry: Registry, problems: list[str]) -> list[tuple[Entry, dict[str, Any]]]:
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
        found.append((Entry(str(extra.get("id", name)), name, options, dict(extra.get("from") or {}), loc), extra))
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


def checked_step(
    entry: Entry,
    available: set[str],
    document: Document,
    registry: Registry,
    base: Path,
    problems: list[str],
    ids: set[str],
) -> Step | None:
    """Return a step with checked options, defaults filled in.

    Parameters
    ----------
    entry : Entry
    available : set of str
        Slots that the scans and the stages before provide; they choose the variant of the stage.
    document, registry : Document, Registry
    base : Path
        Folder of the config, which files among the options are relative to.
    problems : list of str
        Gets what is wrong.
    ids : set of str
        Of the shapes, which options may name; empty where they are not known.

    Returns
    -------
    Step, or None where there is a problem
    """
    try:
        stage = registry.load(entry.stage).suiting(available)
    except ConfigError as error:
        problems.append(f"{document.where(entry.loc)}: {error}")
        return None
    found = len(problems)
    options = dict(entry.options)
    files = _prepared_files(stage, options, base)
    at = entry.loc if entry.loc != ("anatomy",) else ("stages", entry.id)
    config = validated(stage.config, options, at, document, problems)
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


def variant_stages(names: Sequence[str], available: Iterable[str], registry: Registry) -> dict[str, Stage]:
    """Return the stages of a chain by name, in the variant that suits what the scans and the stages before it provide."""
    slots, found = set(available), {}
    for name in names:
        found[name] = registry.load(name).suiting(slots)
        slots |= {port.slot for port in found[name].outputs}
    return found


def enter_at_splines(steps: list[Step], kinds: Mapping[str, str]) -> list[Step]:
    """Let splines enter where the first surface is read: the per-shape steps before it have nothing to do."""
    if "surface" not in kinds:
        return steps
    first = next((i for i, s in enumerate(steps) if any(p.slot == "surface" for p in s.stage.inputs)), 0)
    return steps[first:]
