"""Classes that a configuration names: built-in ones, and those of the user's own."""

from __future__ import annotations

import importlib
import inspect
import sys
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from proto.errors import UserError


def load_class(
    option: str, name: str, built_in: Mapping[str, str], needed: Collection[str]
) -> type[Any]:
    """Find a class by its short name or as `package.module:Class`.

    Modules are looked for in the current folder, too.

    Args:
        option: the configuration's key, for messages, such as `simulator.backend`.
        name: the key's value.
        built_in: `package.module:Class` of the built-in classes by short name.
        needed: attributes and methods that the class must have.

    Raises:
        UserError: there is no such class, its module cannot be imported, or it lacks something.
    """
    known = f"Built in are: {', '.join(sorted(built_in))}"
    path = built_in.get(name, name)
    module_name, colon, class_name = path.partition(":")
    if not colon:
        raise UserError(
            f"{option}: there is no {name!r}. {known}; one of your own is named"
            " package.module:Class."
        )
    _find_in_current_folder()
    try:
        found = getattr(importlib.import_module(module_name), class_name)
    except ModuleNotFoundError as error:
        missing = error.name or ""
        if module_name == missing or module_name.startswith(f"{missing}."):
            raise UserError(
                f"{option}: {name!r} cannot be loaded: there is no module {missing!r}, neither"
                f" installed nor in {Path.cwd()}. {known}."
            ) from error
        raise UserError(
            f"{option}: {module_name} needs the module {missing!r}, which is not installed"
        ) from error
    except AttributeError as error:
        raise UserError(
            f"{option}: {name!r} cannot be loaded: {module_name} has no {class_name!r}. {known}."
        ) from error
    except Exception as error:  # whatever somebody's module raises while it is imported
        raise UserError(
            f"{option}: {module_name} fails while it is imported: {type(error).__name__}: {error}"
        ) from error
    if not inspect.isclass(found):
        raise UserError(f"{option}: {name!r} is no class. {known}.")
    if lacking := _missing(found, needed):
        raise UserError(
            f"{option}: {name!r} lacks {', '.join(lacking)}; needed are {', '.join(needed)}"
        )
    return found


def _missing(found: type[Any], needed: Collection[str]) -> list[str]:
    abstract: frozenset[str] = getattr(found, "__abstractmethods__", frozenset())
    declared = {name for each in found.__mro__ for name in vars(each).get("__annotations__", {})}
    return [
        part
        for part in needed
        if part in abstract or not (hasattr(found, part) or part in declared)
    ]


def _find_in_current_folder() -> None:
    here = str(Path.cwd())
    if here not in sys.path and "" not in sys.path:
        sys.path.append(here)
