"""The faces of the rooms: names that are imported from their modules when they are first used."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import lazy_loader


def lazy_face(package: str, file: str) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """``__getattr__`` and ``__dir__`` of a package whose names its stub, ``__init__.pyi``, lists.

    The stub is read when a name is first asked for: a command, which imports from modules, would
    otherwise read the stubs of a dozen rooms.
    """

    @cache
    def attached() -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
        face: tuple[Any, Any, list[str]] = lazy_loader.attach_stub(package, file)
        return face

    def getattribute(name: str) -> Any:
        if name == "__all__":
            return attached()[2]
        if name.startswith("__"):
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return attached()[0](name)

    return getattribute, lambda: attached()[1]()
