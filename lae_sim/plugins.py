"""What a user names on a command line as ``package.module:object``, and its options.

This module runs under Python 3.8 too, on the side of the tracker.
"""

from __future__ import annotations

import importlib
import inspect
import math
import os
import sys
from collections.abc import Mapping, Sequence
from typing import Any

from lae_sim.errors import LaeError


def key_and_value(text: str) -> tuple[str, str]:
    """An option such as ``size=3``.

    Raises:
        LaeError: if the text is none.
    """
    key, equals, value = text.partition("=")
    if not (equals and key.isidentifier()):
        raise LaeError(f"{text!r} is not key=value")
    return key, value


def bound(what: str, factory: Any, positional: Sequence[Any], options: Mapping[str, Any]) -> Any:
    """Call a factory with options of a command line.

    Args:
        what: what it makes, for messages.
        factory: any callable.
        positional: arguments before the options.
        options: keyword arguments.

    Raises:
        LaeError: if the factory does not take them; it says which it takes.
    """
    try:
        inspect.signature(factory).bind(*positional, **options)
    except TypeError as error:
        raise LaeError(f"{what}: {error}; it takes {_signature(factory)}") from error
    return factory(*positional, **options)


def parse_options(items: Mapping[str, str]) -> dict[str, Any]:
    """Options given as text: ``3``, ``0.5`` and ``true`` become numbers and booleans."""
    return {name: _value(text) for name, text in items.items()}


def _value(text: str) -> Any:
    if text.lower() in ("true", "false"):
        return text.lower() == "true"
    try:
        return int(text)
    except ValueError:
        pass
    try:
        number = float(text)
    except ValueError:
        return text
    return number if math.isfinite(number) else text


def imported(what: str, path: str) -> Any:
    """What a user made and names as ``package.module:factory``.

    Args:
        what: what it is to be, for messages.
        path: the module, which is also looked for in the current folder, and a name in it.

    Raises:
        LaeError: if it cannot be imported, or not be called.
    """
    module, _, attribute = path.partition(":")
    here = os.getcwd()
    if here not in sys.path:
        sys.path.insert(0, here)
    try:
        factory: Any = importlib.import_module(module)
        for part in attribute.split("."):
            factory = getattr(factory, part)
    except Exception as error:  # a user's module may fail in any way while it is imported
        raise LaeError(f"{what}: {type(error).__name__}: {error}") from error
    if not callable(factory):
        raise LaeError(f"{what} is not callable")
    return factory


def _signature(factory: Any) -> str:
    try:
        found = inspect.signature(factory).parameters.values()
    except (TypeError, ValueError):
        return "other options"
    names = [p.name for p in found if p.kind in (p.KEYWORD_ONLY, p.POSITIONAL_OR_KEYWORD)]
    return ", ".join(names) or "no options"
