# SPDX-License-Identifier: Apache-2.0
"""Types and signatures of options, for typer."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Iterable
from contextvars import ContextVar
from pathlib import Path
from typing import Any, Optional, TypeVar, get_type_hints

import typer

from pkm_twin.errors import PkmTwinError

Command = TypeVar("Command", bound=Callable[..., Any])
UsageError: Any = typer.BadParameter.__mro__[1]
"""Of the click that this typer has."""

# typer of Ubuntu 24.04 reads no unions.
OptionalInt = Optional[int]  # noqa: UP045
OptionalFloat = Optional[float]  # noqa: UP045
OptionalText = Optional[str]  # noqa: UP045
OptionalPath = Optional[Path]  # noqa: UP045


def options_of(
    function: Callable[..., Any], *without: str, **types: Any
) -> dict[str, inspect.Parameter]:
    """Parameters of a function as keywords by name, their annotations evaluated.

    :param without: names that are left out. ``types``: of names that only the checker imports.
    """
    hints = get_type_hints(function, localns=types, include_extras=True)
    return {
        name: parameter.replace(annotation=hints[name], kind=inspect.Parameter.KEYWORD_ONLY)
        for name, parameter in inspect.signature(function).parameters.items()
        if name not in without
    }


def take_options(command: Callable[..., Any], options: Iterable[inspect.Parameter]) -> None:
    """Give a function of keywords a signature, for typer."""
    parameters = list(options)
    vars(command)["__signature__"] = inspect.Signature(parameters)
    command.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}


def shared_options(
    declared: Callable[..., None], context: ContextVar[Any], make: Callable[..., Any]
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """A decorator that gives a command more options, for what it calls to look up.

    :param declared: a function whose parameters are the options.
    :param context: is what ``make`` makes of their values while the command runs.
    """
    names = options_of(declared)

    def give(command: Callable[..., None]) -> Callable[..., None]:
        @functools.wraps(command)
        def wrapped(**given: Any) -> None:
            token = context.set(make(*(given.pop(name) for name in names)))
            try:
                command(**given)
            finally:
                context.reset(token)

        take_options(wrapped, [*options_of(command).values(), *options_of(declared).values()])
        return wrapped

    return give


class Commands(typer.Typer):
    """Commands as typer of Ubuntu 24.04 needs them: it evaluates no annotations and shows None.

    Help is plain text, and errors are this package's own.
    """

    def __init__(self, *, add_completion: bool = False, **settings: Any) -> None:
        super().__init__(
            add_completion=add_completion, pretty_exceptions_enable=False, rich_markup_mode=None,
            **settings,
        )  # fmt: skip

    def command(self, *names: Any, **settings: Any) -> Callable[[Command], Command]:
        """As typer's."""
        return _evaluated(super().command(*names, **settings))

    def callback(self, **settings: Any) -> Callable[[Command], Command]:
        """As typer's."""
        return _evaluated(super().callback(**settings))


def _evaluated(register: Callable[[Command], Command]) -> Callable[[Command], Command]:
    def taken(command: Command) -> Command:
        options = options_of(command).values()
        take_options(command, options)
        for option in options:
            if option.default in (None, inspect.Parameter.empty):
                for declared in getattr(option.annotation, "__metadata__", ()):
                    declared.show_default = False
        return register(command)

    return taken


def file_name(option: typer.CallbackParam, path: Path | None) -> Path | None:
    """Callback of an option that names a file to write: neither a folder nor nothing.

    :raises PkmTwinError: by the option's name.
    """
    if path is not None and path.name in ("", ".."):
        raise PkmTwinError(f"{option.opts[-1]}: {str(path)!r} is a folder; expected a file name")
    return path
