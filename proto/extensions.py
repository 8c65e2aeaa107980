"""Classes that the configuration names: built in by a short name, or `package.module:Class`."""

from __future__ import annotations

import importlib
import sys
import traceback
from collections.abc import Collection, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

from proto.errors import UserError


def load_class(
    option: str, name: str, built_in: Mapping[str, str], required: Collection[str]
) -> type[Any]:
    """The class that a name stands for; modules in the current folder are found, too.

    Args:
        option: key of the configuration that holds the name, for messages.
        name: a key of `built_in`, or `package.module:Class`.
        built_in: `package.module:Class` for each short name.
        required: names of the attributes that the class must define; what it only inherits as an
            abstract method does not count.

    Raises:
        UserError: the name is unknown, the module fails while it is imported, or the class is
            missing or incomplete. The message says which.
    """
    known = f"Built in are: {', '.join(sorted(built_in))}" if built_in else "None is built in"
    module_name, separator, class_name = built_in.get(name, name).partition(":")
    if not separator or not _is_dotted_name(module_name) or not class_name:
        raise UserError(
            f"{option}: there is no {name!r}. {known}; a class of your own is named"
            " package.module:Class."
        )
    if name not in built_in:
        _search_current_folder()
    module = _import(option, name, module_name, known)
    found = getattr(module, class_name, None)
    if not isinstance(found, type):
        raise UserError(
            f"{option}: {name!r} cannot be found: {module.__file__} defines no class"
            f" {class_name!r}. {known}."
        )
    if missing := _missing(found, required):
        raise UserError(
            f"{option}: {name!r} ({module.__file__}) is incomplete; it lacks: {', '.join(missing)}."
        )
    return found


def _is_dotted_name(text: str) -> bool:
    return all(part.isidentifier() for part in text.split("."))


def _import(option: str, name: str, module_name: str, known: str) -> ModuleType:
    try:
        return importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module_name}.".startswith(f"{error.name}."):
            raise _import_failed(option, name, error) from error
        raise UserError(
            f"{option}: {name!r} cannot be found: {error}. Searched were {Path.cwd()} and Python's"
            f" path; {known.lower()}."
        ) from error
    except Exception as error:  # whatever the user's module does while it is imported
        raise _import_failed(option, name, error) from error


def _search_current_folder() -> None:
    """Let Python find modules of the current folder, after all others.

    An installed command does not search it by itself. It stays searched: the class may import more
    while it works, and so may the processes that are started for it.
    """
    folder = str(Path.cwd())
    if not {"", folder} & set(sys.path):
        sys.path.append(folder)
        importlib.invalidate_caches()


def _import_failed(option: str, name: str, error: Exception) -> UserError:
    place = ""
    if not isinstance(error, SyntaxError):  # its message names the place
        last = traceback.extract_tb(error.__traceback__)[-1]
        place = f" in {last.filename}, line {last.lineno}"
    return UserError(
        f"{option}: {name!r} was found, but importing it failed{place}:"
        f" {type(error).__name__}: {error}"
    )


def _missing(found: type[Any], required: Collection[str]) -> list[str]:
    abstract: Collection[str] = getattr(found, "__abstractmethods__", frozenset())
    return sorted(name for name in required if not hasattr(found, name) or name in abstract)


def check_attributes(option: str, name: str, made: object, required: Collection[str]) -> None:
    """Refuse an object of a user's class that lacks attributes which `load_class` cannot see.

    Raises:
        UserError: it does; the message lists them.
    """
    if missing := sorted(each for each in required if not hasattr(made, each)):
        raise UserError(
            f"{option}: {name!r} is incomplete; it lacks the attributes: {', '.join(missing)}."
        )
