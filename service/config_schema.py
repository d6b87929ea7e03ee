"""JSON schema of a config, for editors that complete and check its keys; made from the models that read it.

`corridor check` finds more: what no schema can say, such as two sensors on one wire.
"""

import json
import math
from collections.abc import Iterator, Mapping
from typing import Any

from pydantic import BaseModel
from pydantic.json_schema import models_json_schema

from service.mapper.profiles import METHODS, MappingConfig, mapping_model
from service.publishing.keys import MAX_NAME_LENGTH, NAME, NAME_RULE
from service.recording.choice import Choice
from service.sensor_kinds import SENSOR_KINDS
from service.sinks.registry import SINKS

DIALECT = "https://json-schema.org/draft/2020-12/schema"

Schema = dict[str, Any]


def schema_text() -> str:
    """As a file."""
    return json.dumps(config_schema(), indent=1, allow_nan=False) + "\n"


def config_schema() -> Schema:
    """Of a whole config; `$defs` also has "sensor" and "mapping", of one sensor and of that section alone."""
    sections: dict[str, type[BaseModel]] = {kind.section: kind.load_model() for kind in SINKS}
    sections["replay"] = Choice
    sensors = {name: kind.config for name, kind in SENSOR_KINDS.items()}
    profiles = {name: mapping_model({"profile": name}) for name in METHODS}
    models: list[type[BaseModel]] = [*sections.values(), *sensors.values(), *profiles.values(), MappingConfig]
    references, content = models_json_schema([(model, "validation") for model in models])
    definitions: Schema = {name: _plain(schema) for name, schema in content["$defs"].items()}

    def of(model: type[BaseModel]) -> Schema:
        return dict(references[model, "validation"])

    for model in sensors.values():
        _without_name(definitions[of(model)["$ref"].rpartition("/")[2]])
    definitions["sensor"] = _chosen_by("type", {name: of(model) for name, model in sensors.items()})
    default = MappingConfig.model_fields["profile"].default
    definitions["mapping"] = {  # the settings of components that a config chooses itself: anything
        "if": {"required": ["components"]},
        "then": of(MappingConfig),
        "else": _chosen_by("profile", {name: of(model) for name, model in profiles.items()}, default),
        "properties": {"profile": {"enum": list(profiles)}},
    }
    needed = [name for name, model in sections.items() if _needs_something(model)]
    return {
        "$schema": DIALECT,
        "title": "config of corridor",
        "type": "object",
        "required": ["vehicle", "sensors", *needed],
        "additionalProperties": False,
        "properties": {
            "vehicle": {"type": "string", "description": NAME_RULE, **_name()},
            "sensors": {
                "type": "object",
                "description": "name of each sensor -> its type and settings",
                "minProperties": 1,
                "propertyNames": _name(),
                "additionalProperties": {"$ref": "#/$defs/sensor"},
            },
            "mapping": _or_empty({"$ref": "#/$defs/mapping"}),
            **{
                name: of(model) if name in needed else _or_empty(of(model))
                for name, model in sections.items()
            },
        },
        "$defs": definitions,
    }


def _name() -> Schema:
    return {"pattern": f"^{NAME.pattern}$", "maxLength": MAX_NAME_LENGTH}


def _or_empty(schema: Schema) -> Schema:
    """A section that is there without content has its defaults."""
    return {"type": ["object", "null"], "if": {"type": "object"}, "then": schema}


def _needs_something(model: type[BaseModel]) -> bool:
    return any(field.is_required() for field in model.model_fields.values())


def _without_name(sensor: Schema) -> None:
    """The name is the key above."""
    sensor["properties"].pop("name")
    sensor["required"] = ["type", *(key for key in sensor.get("required", ()) if key not in ("type", "name"))]


def _chosen_by(key: str, schemas: Mapping[str, Schema], default: str | None = None) -> Schema:
    """What the value of a key chooses; left out: the default, or the key is needed."""
    rules = [
        {"if": {"required": [key], "properties": {key: {"const": value}}}, "then": schema}
        for value, schema in schemas.items()
    ]
    chosen: Schema = {"type": "object", "properties": {key: {"enum": list(schemas)}}, "allOf": rules}
    if default is None:
        return chosen | {"required": [key]}
    rules.append({"if": {"not": {"required": [key]}}, "then": schemas[default]})
    return chosen


def _is_json(value: Any) -> bool:
    """Not NaN, which stands for "not given", and not infinity."""
    return not isinstance(value, float) or math.isfinite(value)


def _plain(schema: Any) -> Any:
    """Without the titles that pydantic makes of names, and without defaults of several keys."""
    if isinstance(schema, list):
        return [_plain(one) for one in schema]
    if not isinstance(schema, dict):
        return schema
    return dict(_kept(schema))


def _kept(schema: Schema) -> Iterator[tuple[str, Any]]:
    for key, value in schema.items():
        if key == "properties":
            yield key, {name: _plain(one) for name, one in value.items()}
        elif key == "default" and not isinstance(value, dict) and _is_json(value):
            yield key, value
        elif key not in ("title", "default"):
            yield key, _plain(value)
