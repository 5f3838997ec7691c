"""What a user names on a command line as ``package.module:object``, and its options.

This module runs under Python 3.8 too, on the side of the tracker.
"""

from __future__ import annotations

import functools
import importlib
import inspect
import math
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.machinery import PathFinder
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


def imported(what: str, name: str) -> tuple[Any, dict[str, Any]]:
    """What a user made and names as ``package.module:object``, and the options after that.

    Options are as in ``mine:Damped:a=0.3,steps=2``.

    Args:
        what: what it is to be, for messages.
        name: the module, which is also looked for in the current folder, a name in it, and options.

    Raises:
        LaeError: if it cannot be imported, or not be called, or the options are none.
    """
    module, _, rest = name.partition(":")
    attribute, colon, options = rest.partition(":")
    _look_here()
    importlib.invalidate_caches()  # the file may have been written a moment ago
    _check_origin(what, module)
    try:
        made: Any = importlib.import_module(module)
        for part in attribute.split("."):
            made = getattr(made, part)
    except Exception as error:  # a user's module may fail in any way while it is imported
        said = f"{what}: {type(error).__name__}: {error}"
        if isinstance(error, ModuleNotFoundError):
            named = f"{module}.".startswith(f"{error.name}.")
            suffixed = named and module.endswith(".py")
            said += "; leave out .py" if suffixed else f"; searched {', '.join(_searched())}"
        raise LaeError(said) from error
    if not callable(made):
        raise LaeError(f"{what} is not callable: name a class or a function")
    try:
        return made, parse_options(dict(map(key_and_value, options.split(",") if colon else ())))
    except LaeError as error:
        raise LaeError(f"{what}: {error}") from error


def _searched() -> Iterator[str]:
    """The folders that modules are looked for in, but for those of the standard library."""
    library = os.path.dirname(os.__file__)
    for folder in dict.fromkeys(map(os.path.abspath, sys.path)):
        if os.path.isdir(folder) and folder not in (library, os.path.join(library, "lib-dynload")):
            yield folder


def _look_here() -> None:
    here = os.getcwd()
    if here not in sys.path:
        sys.path.insert(0, here)


@contextmanager
def looking_in(folder: str | os.PathLike[str]) -> Iterator[None]:
    """Let users' modules be found in a folder, such as that of a study file, before all others."""
    _look_here()  # behind it
    path = os.path.abspath(folder)
    sys.path.insert(0, path)
    try:
        yield
    finally:
        sys.path.remove(path)


def _check_origin(what: str, module: str) -> None:
    """Check that what was imported under a name is what would be found under it now.

    Raises:
        LaeError: if it is another folder's.
    """
    top = module.partition(".")[0]
    before: str | None = getattr(sys.modules.get(top), "__file__", None)
    if before is None or top == "__main__":
        return
    found = PathFinder.find_spec(top)
    if found and found.origin and os.path.realpath(found.origin) != os.path.realpath(before):
        raise LaeError(
            f"{what}: this process has imported another {top}, {before}: rename one of them, or "
            "start anew"
        )


def with_options(
    what: str, made: Any, options: Mapping[str, Any], arguments: Sequence[str]
) -> Callable[..., Any]:
    """What a user made, with options of its name; checked to take what it will be called with.

    Args:
        what: what it is, for messages.
        made: a function or a class.
        options: keyword arguments.
        arguments: names of the positional arguments that it will be called with.

    Raises:
        LaeError: if it does not take them; it says what it takes, and where that is written.
    """
    check_call(what, made, arguments, options)
    if not options:
        called: Callable[..., Any] = made
        return called
    kept = () if isinstance(made, type) else ("__dict__",)  # attributes of a function
    return functools.update_wrapper(functools.partial(made, **options), made, updated=kept)


def check_methods(what: str, made: Any, methods: Mapping[str, Sequence[str]]) -> None:
    """Check that a user's object, or a class of such, has methods that take what they are given.

    Args:
        what: what it is, for messages.
        made: the object or the class.
        methods: the names of each one's arguments.

    Raises:
        LaeError: if a method is missing, or takes other arguments; it says where that is written.
    """
    kind = made if isinstance(made, type) else type(made)
    for name, arguments in methods.items():
        method = getattr(made, name, None)
        if not callable(method):
            raise LaeError(
                f"{what}: {_name_of(kind)}{_place(kind)} has no method "
                f"{name}({', '.join(arguments)})"
            )
        static = isinstance(inspect.getattr_static(kind, name, None), (staticmethod, classmethod))
        unbound = isinstance(made, type) and not static
        check_call(what, method, arguments, own=("self",) if unbound else ())


def check_call(
    what: str,
    called: Any,
    arguments: Sequence[str],
    options: Mapping[str, Any] | None = None,
    own: Sequence[str] = (),
) -> None:
    """Check that something a user made can be called in a way.

    Args:
        what: what it is, for messages.
        called: a function, a class or a method.
        arguments: names of the positional arguments.
        options: keyword arguments.
        own: arguments before these, of which nothing is said.

    Raises:
        LaeError: if it does not take them; it says what it takes, and where that is written.
    """
    try:
        signature = inspect.signature(called)
    except (TypeError, ValueError):  # of C, it tells nothing
        return
    options = options or {}
    try:
        signature.bind(*own, *arguments, **options)
    except TypeError as error:
        name = _name_of(called)
        asked = ", ".join([*arguments, *(f"{key}={value!r}" for key, value in options.items())])
        raise LaeError(
            f"{what}: {name}{signature}{_place(called)} is called as {name}({asked}): {error}"
        ) from error


def _name_of(made: Any) -> str:
    name = getattr(made, "__qualname__", None) or type(made).__qualname__
    return str(name).rpartition("<locals>.")[2]


def _place(made: Any) -> str:
    """Where a function, a class or the class of an object is written, as far as that is known."""
    for each in (made, getattr(made, "__init__", None), type(made).__call__):
        code = getattr(each, "__code__", None)
        if code is not None:
            return f" ({code.co_filename}, line {code.co_firstlineno})"
    file = getattr(sys.modules.get(getattr(made, "__module__", "")), "__file__", None)
    return f" ({file})" if file else ""


def _signature(factory: Any) -> str:
    try:
        found = inspect.signature(factory).parameters.values()
    except (TypeError, ValueError):
        return "other options"
    names = [p.name for p in found if p.kind in (p.KEYWORD_ONLY, p.POSITIONAL_OR_KEYWORD)]
    return ", ".join(names) or "no options"
