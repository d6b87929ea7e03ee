"""What a calibration changes in a config: as a patch, and merged into the config with its comments kept."""

import io
import json
from collections.abc import Mapping
from typing import Any

import yaml
from pydantic import ValidationError
from pydantic_core import ErrorDetails
from ruamel.yaml import YAML

from service.config import ServiceConfig, parse_config
from service.offline.calibrate.fit import Fit
from service.offline.replay.setup import overlay

Changes = dict[str, dict[str, Any]]  # sensor -> key -> value; a mapping is merged into the one that is there


def wheel_settings(fit: Fit, wheel_base_m: float, left_scale: float, right_scale: float) -> dict[str, float]:
    """Settings by which irobot_create counts the true path; the arguments are as it was.

    With both wheels' scales s (1 - e) and s (1 + e) the distance is s times, the turn s b / b' times
    that counted, and 2 s e / b' rad a metre counted come on top.
    """
    scale, turn_scale = fit["scale"], fit["turn_scale"]
    new_base_m = wheel_base_m * scale / turn_scale
    uneven = fit["turn_per_m"] * new_base_m / (2.0 * scale)
    return {
        "wheel_base_m": round(new_base_m, 5),
        "left_scale": round(left_scale * scale * (1.0 - uneven), 5),
        "right_scale": round(right_scale * scale * (1.0 + uneven), 5),
    }


def why_not_taken(values: Mapping[str, Any], settings: Any) -> str:
    """Values that the settings of a sensor refuse, and why; "" where they accept all."""
    merged = settings.model_dump(mode="json", exclude_unset=True)
    overlay(merged, values)
    try:
        type(settings).model_validate_json(json.dumps(merged), strict=True)
    except ValidationError as error:
        return "; ".join(_words(detail) for detail in error.errors(include_url=False))
    return ""


def _words(detail: ErrorDetails) -> str:
    key, got = ".".join(map(str, detail["loc"])), detail["input"]
    if detail["type"] == "extra_forbidden":
        return f"unknown key {key}"
    why = detail["msg"].removeprefix("Value error, ").removeprefix("Input ")
    return f"{key} {got}: {why}" if isinstance(got, int | float) else f"{key} {why}".strip()


def patched(changes: Changes, config: ServiceConfig | None) -> tuple[str, str]:
    """The patch, and the complete config with it; that is empty where there is no config.

    changes   of a sensor that the config has: as why_not_taken lets them pass

    Sensors that the config does not have are left out of it.
    """
    if not changes:
        return "", "" if config is None else config.text
    patch = yaml.safe_dump({"sensors": changes}, sort_keys=False, default_flow_style=None, width=100)
    if config is None:
        return patch, ""
    editor = YAML()
    editor.preserve_quotes = True
    editor.width = 200
    document = editor.load(config.text)
    for name, values in changes.items():
        if name in document["sensors"]:
            overlay(document["sensors"][name], values)
    stream = io.StringIO()
    editor.dump(document, stream)
    parse_config(stream.getvalue(), "the calibrated config")
    return patch, stream.getvalue()
