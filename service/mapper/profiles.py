"""Profile name -> its components and their settings. The only module that knows methods by name.

A profile is a folder of methods/ with a method.py, and its name in METHODS. It is imported when it is chosen.
A config may use a component of another method: `components: {matcher: surfel_gauss_newton}`; a component that
cannot read the local map is refused.
"""

from collections.abc import Callable, Iterable, Mapping
from copy import copy
from dataclasses import dataclass, replace
from functools import partial
from importlib import import_module
from typing import Any, Literal

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    ValidationInfo,
    create_model,
    field_validator,
)
from pydantic.fields import FieldInfo

from drivers.section import Section
from service.geometry.geo_reference import GeoReference
from service.geometry.se2 import SE2
from service.mapper.background import InlineWorker, NewWorker
from service.mapper.components import (
    SLOTS,
    BuildContext,
    ComponentKind,
    Components,
    Method,
    RenderedMap,
    Slot,
    Stopwatch,
)
from service.mapper.map_changes import ChangeWatch
from service.mapper.patch_store import MemoryPatches, NewPatchStore
from service.mapper.pipeline import Mapper
from service.mapper.saved_graph import KeepGraph, SavedGraph
from service.suggestion import suggest


def _imported(name: str) -> Method:
    method: Method = import_module(f"service.mapper.methods.{name}.method").METHOD
    return method


METHODS: dict[str, Callable[[], Method]] = {
    name: partial(_imported, name)
    for name in ("corridor", "contour_lm", "imle", "submap_graph", "owolm_eskf")
}


def import_methods() -> None:
    """Import every profile."""
    for method in METHODS.values():
        method()


def component_kinds(slot: Slot, profiles: Iterable[str] | None = None) -> dict[str, ComponentKind]:
    """Components for a slot, by name: of these profiles, or of all."""
    methods = [METHODS[name]() for name in (METHODS if profiles is None else profiles)]
    kinds = [kind for method in methods for kind in (method.components[slot], *method.others.get(slot, ()))]
    return {kind.name: kind for kind in kinds}


def chosen_components(profile: str, components: Mapping[Slot, str]) -> dict[Slot, ComponentKind]:
    """The component of each slot: the profile's own, or the one that `components` names.

    Raises ValueError for an unknown component, or one that cannot read the local map.
    """
    chosen = dict(METHODS[profile]().components)
    for slot, name in components.items():
        kinds = component_kinds(slot, [profile])
        if name not in kinds and name not in (kinds := component_kinds(slot)):
            raise ValueError(f"{name} is no {slot}; {suggest(name, kinds)}")
        chosen[slot] = kinds[name]
    local_map = chosen["local_map"]
    for slot, kind in chosen.items():
        if _fits(kind, local_map):
            continue
        maps = [other.name for other in component_kinds("local_map").values() if _fits(kind, other)]
        readers = [other.name for other in component_kinds(slot).values() if _fits(other, local_map)]
        raise ValueError(
            f"the {slot} {kind.name} cannot read the local_map {local_map.name}; it reads {', '.join(maps)}. "
            f"What reads {local_map.name} as {slot}: {', '.join(readers) or 'nothing'}"
        )
    return chosen


@dataclass(frozen=True, slots=True, eq=False)
class BeginIn:
    """The stored map that a session starts in."""

    graph: SavedGraph
    shown: RenderedMap
    geo: GeoReference | None = None  # its geographic reference


class MappingConfig(Section):
    """Settings of the mapper: profile, components, their parameters, cell size of the shown map.

    The class by mapping_model has the `settings` of the chosen components.
    """

    profile: str = "corridor"
    cell_m: float = Field(default=0.05, ge=0.01, le=0.5)
    mode: Literal["mapping", "localization"] = "mapping"
    outline_m: tuple[tuple[float, float], ...] = ()  # vehicle corners, base frame; returns within go
    components: dict[Slot, str] = Field(default_factory=dict)
    settings: Any = None  # by slot: settings of its component; None: the profile's

    @field_validator("profile")
    @classmethod
    def _known(cls, profile: str) -> str:
        if profile not in METHODS:
            raise ValueError(f"{profile} is no profile; {suggest(profile, METHODS)}")
        return profile

    @field_validator("components")
    @classmethod
    def _fitting(cls, components: dict[Slot, str], info: ValidationInfo) -> dict[Slot, str]:
        if "profile" in info.data:
            chosen_components(info.data["profile"], components)
        return components

    @field_validator("outline_m")
    @classmethod
    def _a_polygon(cls, outline_m: tuple[tuple[float, float], ...]) -> tuple[tuple[float, float], ...]:
        if 0 < len(outline_m) < 3:
            raise ValueError(f"an outline has 3 corners [x, y] in m or more, not {len(outline_m)}")
        return outline_m


def begins_in_stored(config: MappingConfig) -> bool:
    """Whether a session with this config can start in a stored map."""
    return chosen_components(config.profile, config.components)["graph"].begins_in_stored


def mapping_model(section: Mapping[str, Any]) -> type[MappingConfig]:
    """Model of a mapping section, with the settings of the components that it chooses.

    A section with an unknown component gets the plain model, whose validators report it.
    """
    profile, components = section.get("profile", "corridor"), section.get("components") or {}
    try:
        chosen = chosen_components(profile, components)
    except (ValueError, TypeError, KeyError, AttributeError):
        return MappingConfig
    method = METHODS[profile]()
    fields: dict[str, Any] = {}
    for slot, kind in chosen.items():
        if not kind.config.model_fields:
            continue
        own = method.settings.get(slot, {}) if kind is method.components[slot] else {}
        model = _with_defaults(kind.config, own)
        fields[slot] = (model, model())
    settings = create_model("Settings", __config__=ConfigDict(frozen=True, extra="forbid"), **fields)
    return create_model("MappingConfig", __base__=MappingConfig, settings=(settings, settings()))


def mapping_config(section: Mapping[str, Any] | None = None) -> MappingConfig:
    """The validated mapping section of a config. Raises pydantic.ValidationError."""
    section = section or {}
    return mapping_model(section).model_validate(section)


def with_profile(profile: str, mapping: MappingConfig) -> MappingConfig:
    """The same vehicle with another profile and its default settings.

    Raises ValueError for an unknown profile.
    """
    kept = {"cell_m": mapping.cell_m, "outline_m": mapping.outline_m}
    try:
        return mapping_config({"profile": profile, **kept})
    except ValidationError as error:
        raise ValueError(error.errors()[0]["msg"].removeprefix("Value error, ")) from error


def build_mapper(
    config: MappingConfig,
    mountings: Mapping[str, SE2],
    stopwatch: Stopwatch | None = None,
    new_worker: NewWorker = InlineWorker,
    new_patch_store: NewPatchStore = MemoryPatches,
    begin_in: BeginIn | None = None,
    keep_graph: KeepGraph | None = None,
) -> Mapper[Any]:
    """A new mapper.

    mountings    pose_base_sensor of each laser, by its name
    new_worker   runs the graph's back end
    new_patch_store   stores distant patches of a map
    begin_in     the stored map to localise in; None: a new map
    keep_graph   as of BuildContext

    Raises ValueError if the profile's graph cannot start in a stored map.
    """
    if config.settings is None:
        config = mapping_config(config.model_dump(exclude={"settings"}))
    chosen = chosen_components(config.profile, config.components)

    if begin_in is not None and not begins_in_stored(config):
        raise ValueError(
            f"the profile {config.profile} cannot begin in a stored map; the profile corridor can"
        )

    def build(slot: Slot, around: BuildContext) -> Any:
        return chosen[slot].build(getattr(config.settings, slot, None), around)

    around = BuildContext(
        config.cell_m,
        mountings,
        config.outline_m,
        new_worker=new_worker,
        new_patch_store=new_patch_store,
        stored=None if begin_in is None else begin_in.graph,
        is_localizing=config.mode == "localization",
        keep_graph=keep_graph,
    )
    free_space = build("free_space", around)
    around = replace(around, renderer=free_space.renderer)
    built = {slot: build(slot, around) for slot in SLOTS if slot != "free_space"}
    if begin_in is not None:
        free_space.replace_by(begin_in.shown, ())
    return Mapper(
        Components(free_space=free_space, **built),
        stopwatch,
        "proven" if begin_in is None else "unknown",
        around.is_localizing,
        None if begin_in is None else begin_in.geo,
        ChangeWatch(begin_in.shown, config.cell_m) if begin_in is not None and around.is_localizing else None,
    )


def _with_defaults(config: type[BaseModel], defaults: Mapping[str, Any]) -> type[BaseModel]:
    """The same settings with other defaults. Keys of a nested model may be given alone."""
    if not defaults:
        return config
    fields: dict[str, Any] = {}
    for key, value in defaults.items():
        annotation = config.model_fields[key].annotation
        if isinstance(value, Mapping) and isinstance(annotation, type) and issubclass(annotation, BaseModel):
            annotation = _with_defaults(annotation, value)
            fields[key] = (annotation, annotation())
        else:
            fields[key] = (annotation, _field_with_default(config, key, value))
    return create_model(config.__name__, __base__=config, **fields)


def _field_with_default(config: type[BaseModel], key: str, value: Any) -> FieldInfo:
    field = copy(config.model_fields[key])
    field.default = value
    return field


def _fits(reader: ComponentKind, local_map: ComponentKind) -> bool:
    return reader.reads is None or (local_map.makes is not None and issubclass(local_map.makes, reader.reads))
