"""Parts of a located YAML document as pydantic models: a fault with its place for what a model refuses."""

import json
import re
import typing
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from service.errors import ConfigError
from service.located_yaml import MAX_FILE_BYTES, Document, Fault
from service.located_yaml import Path as KeyPath
from service.suggestion import unknown_key

ModelT = TypeVar("ModelT", bound=BaseModel)


def read_file(path: Path) -> str:
    """The text of a YAML file. Raises ConfigError where it cannot be read."""
    try:
        with path.open("rb") as file:
            content = file.read(MAX_FILE_BYTES + 1)
        refuse_large(content, path)
        return content.decode("utf-8")
    except UnicodeDecodeError as error:
        before = error.object[: error.start]
        line, column = before.count(b"\n") + 1, len(before.rpartition(b"\n")[2].decode("utf-8")) + 1
        what = f"byte 0x{error.object[error.start]:02x} is not UTF-8; save the file as UTF-8"
        raise ConfigError([f"{path}:{line}:{column}: {what}"]) from error
    except (OSError, ValueError) as error:  # ValueError: a NUL in the path
        reason = getattr(error, "strerror", None) or error
        raise ConfigError([f"{path}: cannot be read: {reason}"]) from error


def refuse_large(content: bytes | str, file: object) -> None:
    """Before it is parsed, which takes seconds for a megabyte. Raises ConfigError."""
    if len(content) > MAX_FILE_BYTES:
        raise ConfigError([f"{file}: larger than {MAX_FILE_BYTES} bytes; that is no config"])


def raise_faults(document: Document, file: str) -> None:
    """Raises ConfigError with every fault of the document, in the order of its lines; `file` names it."""
    if document.faults:
        faults = sorted(document.faults, key=lambda fault: (fault.position.line, fault.position.column))
        raise ConfigError(list(dict.fromkeys(fault.text(file) for fault in faults)))


def add_fault(document: Document, path: KeyPath, message: str) -> None:
    """One of a place: what is not even YAML is reported once."""
    if all(fault.path != path for fault in document.faults):
        document.faults.append(Fault(document.position(path), path, message))


def validated(
    document: Document, path: KeyPath, model: type[ModelT], settings: object, own_keys: Collection[str] = ()
) -> ModelT | None:
    """What stands at that path as a model; None, with its faults in the document, where the model refuses it.

    own_keys   fields of the model that are not suggested for an unknown key
    """
    if not isinstance(settings, dict):
        keys = ", ".join(key for key in model.model_fields if key not in own_keys)
        add_fault(document, path, f"this is a mapping with the keys {keys}")
        return None
    try:
        # JSON mode is strict about kinds ("2111" is no number, true is not 1), yet takes lists and paths.
        return model.model_validate_json(json.dumps(settings), strict=True)
    except ValidationError as error:
        for detail in error.errors(include_url=False):
            _refuse(document, path, model, detail, own_keys)
        return None


def _refuse(
    document: Document, path: KeyPath, model: type[BaseModel], detail: ErrorDetails, own_keys: Collection[str]
) -> None:
    at, got = path, detail["input"]
    for part in detail["loc"]:  # pydantic puts the tag of a union in between, which is no key
        if (*at, part) in document.positions:
            at = (*at, part)
    match detail["type"]:
        case "extra_forbidden":
            models = _models_at(model, detail["loc"][:-1])
            known = sorted({name for found in models for name in found.model_fields}.difference(own_keys))
            add_fault(document, at, unknown_key(str(detail["loc"][-1]), got, known))
        case "missing":
            missing = (*at, str(detail["loc"][-1]))
            add_fault(document, missing, "missing, and there is no sensible default")
        case _:
            message = detail["msg"].removeprefix("Value error, ").removeprefix("Input ")
            message = message.replace("valid array", "list")
            is_plain = got is None or isinstance(got, bool | int | float | str)
            shown = f" (got {json.dumps(got)})" if is_plain else ""
            add_fault(document, at, message + shown + _correction(model, detail))


def _correction(model: type[BaseModel], detail: ErrorDetails) -> str:
    """What to write instead of a value of the wrong kind, where that is known."""
    got = detail["input"]
    match detail["type"]:
        case "int_type" | "float_type" if isinstance(got, str) and re.fullmatch(r"[-+]?[\d.]+", got):
            return f"; write {got} without quotes"
        case "int_type" | "float_type":
            return "; write a number"
        case "bool_type":
            return "; write true or false"
        case "string_type" if isinstance(got, int | float) and not isinstance(got, bool):
            for found in _models_at(model, detail["loc"][:-1]):
                info = found.model_fields.get(str(detail["loc"][-1]))
                if info is not None and isinstance(info.default, str):
                    return f'; write "{info.default}", say'
            return f'; write it in quotes: "{got}"'
    return ""


def _models_at(model: type[BaseModel], location: tuple[int | str, ...]) -> list[type[BaseModel]]:
    """What `location` leads to."""
    models = [model]
    for part in location:
        found = [inner for outer in models for inner in _models_in(outer, part)]
        models = found or models  # a union's tag leads nowhere
    return models


def _models_in(model: type[BaseModel], field: int | str) -> Iterator[type[BaseModel]]:
    info = model.model_fields.get(str(field))
    pending: list[Any] = [info.annotation] if info is not None else []
    while pending:
        annotation = pending.pop()
        if isinstance(annotation, type) and issubclass(annotation, BaseModel):
            yield annotation
        pending.extend(typing.get_args(annotation))
