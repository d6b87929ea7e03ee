"""Kinds by name, each imported with its first use: a start needs two types of five."""

from collections.abc import Iterator, Mapping
from importlib import import_module
from typing import TypeVar

KindT = TypeVar("KindT")


class LazyRegistry(Mapping[str, KindT]):
    """Name -> the KIND of a module. Asking which names there are imports none of them.

    modules  name -> the module whose KIND it is
    kind     the type that each KIND must have; TypeError where it has another
    """

    def __init__(self, kind: type[KindT], modules: Mapping[str, str]) -> None:
        self._kind = kind
        self._modules = dict(modules)

    def __getitem__(self, name: str) -> KindT:
        module = self._modules[name]
        found = import_module(module).KIND
        if not isinstance(found, self._kind):
            raise TypeError(f"{module}.KIND is a {type(found).__name__}, expected a {self._kind.__name__}")
        return found

    def __contains__(self, name: object) -> bool:
        return name in self._modules

    def __iter__(self) -> Iterator[str]:
        return iter(self._modules)

    def __len__(self) -> int:
        return len(self._modules)
