"""JSON Schema of the config, options of all stages included, for completion and checks in editors."""

from __future__ import annotations

from typing import Any

from ssmpipe.contract import Stage
from ssmpipe.runner.config import RunConfig
from ssmpipe.runner.presets import PRESETS
from ssmpipe.runner.registry import Registry


def config_schema(registry: Registry) -> dict[str, Any]:
    """Return the schema; every stage's options are those of its own config."""
    schema = RunConfig.model_json_schema()
    schema["$schema"] = "https://json-schema.org/draft/2020-12/schema"
    schema["title"] = "ssmpipe config"
    anatomy = schema["properties"]["anatomy"]
    anatomy["anyOf"] = [{"type": "string", "enum": list(PRESETS)}, {"type": "null"}]
    names = registry.names()
    entries: list[dict[str, Any]] = [{"type": "string", "enum": list(names)}]
    for name in names:
        stage = registry.load(name)
        options = stage.config.model_json_schema(ref_template=f"#/$defs/{name}/$defs/{{model}}")
        options["description"] = registry.summary(name)
        options["properties"] = _with_variants(options.get("properties", {}), stage)
        options["properties"] |= {
            "id": {"type": "string", "description": "Name that tells repeats of a stage apart."},
            "skip": {"type": "boolean", "description": "Leave this stage of the preset out.", "default": False},
            "after": {"type": "string", "description": "Insert into the preset's chain after this step."},
            "from": {
                "type": "object",
                "additionalProperties": {"type": "string"},
                "description": "Which step a slot is read from: {slot: step}; by default the newest that makes it.",
            },
        }
        schema.setdefault("$defs", {})[name] = options
        entries.append(
            {
                "type": "object",
                "properties": {name: {"anyOf": [{"$ref": f"#/$defs/{name}"}, {"type": "null"}]}},
                "required": [name],
                "additionalProperties": False,
            }
        )
    schema["properties"]["stages"]["items"] = {"oneOf": entries}
    return schema


def _with_variants(properties: dict[str, Any], stage: Stage) -> dict[str, Any]:
    """Add the options that a stage has for other kinds of input; one of the same name may have either form."""
    merged = dict(properties)
    for variant in stage.variants:
        for key, option in variant.config.model_json_schema().get("properties", {}).items():
            merged[key] = option if merged.get(key, option) == option else {"anyOf": [merged[key], option]}
    return merged
