"""The section ``input`` of a config: the scans it names and what its tables know of them; every problem is noted."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from ssmpipe.core.errors import ConfigError, SsmpipeError
from ssmpipe.runner.config import InputConfig
from ssmpipe.runner.document import Document
from ssmpipe.runner.presets import PRESETS
from ssmpipe.runner.sources import (
    ID,
    IMAGE_SUFFIXES,
    OUTLINE_SUFFIXES,
    SPLINE_SUFFIX,
    Source,
    by_id,
    find_sources,
    scan_files,
)
from ssmpipe.runner.suggest import count, did_you_mean


def are_pictures(scans: str | list[str] | None) -> bool:
    """Whether the names of the scans, found or not, are those of pictures."""
    given = scans if isinstance(scans, list) else [scans or ""]
    return any(Path(pattern).suffix.lower() in IMAGE_SUFFIXES for pattern in given)


def usable_input(document: Document) -> InputConfig:
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


def input_sources(
    section: InputConfig, document: Document, base: Path, problems: list[str], *, planar: bool, complete: bool
) -> tuple[list[Source], list[str]]:
    """Find the scans and read the tables; problems of all of them are noted, not only the first one's.

    Parameters
    ----------
    section : InputConfig
    document : Document
    base : Path
        Folder of the config, which paths are relative to.
    problems : list of str
        Gets a line for each problem.
    planar : bool
        Whether the chain begins with outlines, so that tables in a folder are scans.
    complete : bool
        Whether the section is all that the config says, and not what could be read of one with problems.

    Returns
    -------
    list of Source, list of str
        The scans and what is to be warned of; none where there is a problem.
    """
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
