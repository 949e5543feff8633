# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Commands: a class of settings is their options, and a function of it gives their report."""

from __future__ import annotations

import dataclasses
import gc
import inspect
import math
import os
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Final, Optional, TypeVar, Union, get_args, get_origin
from typing import get_type_hints as hints_of

import typer
from typer.core import TyperCommand, TyperGroup

from pkm_twin.apps.options import BESIDE
from pkm_twin.console import numbers, refuse_existing
from pkm_twin.errors import FileError, ParameterError, PkmTwinError, UnknownNameError
from pkm_twin.files import STANDARD, decimal
from pkm_twin.report import Fact, Report
from pkm_twin.report.terminal import present
from pkm_twin.settings import Setting

G = TypeVar("G")

LARGEST_SHOWN: Final = 1e5
"""A bound of more is there to catch slips, and not told in the help."""
_NEGATIVE: Final = re.compile(r"-\.?\d")
_JSON: Final = inspect.Parameter(
    "as_json",
    inspect.Parameter.KEYWORD_ONLY,
    default=False,
    annotation=Annotated[bool, typer.Option("--json", help="print JSON")],
)


class Commands(typer.Typer):
    """A program: its help is plain text, and its errors are this package's own."""

    def __init__(self, *, add_completion: bool = False, **settings: Any) -> None:
        super().__init__(
            add_completion=add_completion, pretty_exceptions_enable=False, rich_markup_mode=None,
            **settings,
        )  # fmt: skip


@dataclass(frozen=True)
class Command:
    """A command: a function of a class of settings.

    ``given``: the class; its docstring is the help, its fields are the options. ``task``: the
    heading in the list of commands; empty for a command of a group.
    """

    given: type[Any]
    run: Callable[[Any], Report]
    task: str = ""
    hidden: bool = False

    def app(self, name: str) -> typer.Typer:
        """It alone as a program."""
        app = Commands()
        self.add_to(app, name)
        return app

    def add_to(self, app: typer.Typer, name: str) -> None:
        """Make it a command of a program."""
        fields = _fields(self.given)

        def call(**values: Any) -> None:
            as_json = values.pop("as_json")
            settings = {
                name: _taken(name, kind, row, values[name]) for name, kind, row, _ in fields
            }
            execute(self, name, self.given(**settings), as_json)

        parameters = [_parameter(*field) for field in fields]
        vars(call)["__signature__"] = inspect.Signature([*parameters, _JSON])
        call.__annotations__ = {p.name: p.annotation for p in [*parameters, _JSON]}
        rows = [(field, row) for field, _, row, _ in fields]
        known = {_spelled(field, row): row.older for field, row in rows}
        older = {old: new for new, olds in known.items() for old in olds}
        usual = {name.replace("--no-", "--") for name in known if name.startswith("--no-")}
        cls = type("_Words", (_Words,), {"older": older, "usual": usual - known.keys()})
        app.command(
            name, cls=cls, help=inspect.cleandoc(self.given.__doc__ or ""), hidden=self.hidden
        )(call)


def command(run: Callable[[G], Report], task: str = "", *, hidden: bool = False) -> Command:
    """The command of a function; the class of its one parameter declares the options.

    :param task: the heading in the list of commands.
    """
    ((_, given),) = ((k, v) for k, v in hints_of(run).items() if k != "return")
    return Command(given, run, task, hidden)


@dataclass(frozen=True)
class Group:
    """Commands under one name; ``metavar``: what follows the name, in help."""

    text: str
    commands: dict[str, Command]
    task: str = ""
    metavar: str = "COMMAND [OPTIONS]"

    def ordered(self, words: list[str]) -> list[str]:
        """The words after the group's name, the command's name first."""
        return words

    def shown(self, name: str) -> str:
        """A command's name as it is typed, with arguments that stand before it."""
        return name

    def app(self, name: str) -> typer.Typer:
        """The group as a program."""
        cls = type("_Ordered", (_Ordered,), {"group": self})
        text = inspect.cleandoc(self.text)
        app = Commands(help=text, name=name, cls=cls, subcommand_metavar=self.metavar)
        for each, one in self.commands.items():
            one.add_to(app, each)
        return app


class _Ordered(TyperGroup):
    """A group that names the command closest to a wrong one."""

    group: Group

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        # But for the group's own options, of which there is only --help.
        return [str(self.subcommand_metavar)]

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        return super().parse_args(ctx, self.group.ordered(args))

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        if args[0] not in self.commands:
            unknown = UnknownNameError(str(ctx.info_name), args[0], tuple(self.commands))
            raise typer.BadParameter(str(unknown), ctx)
        name, found, rest = super().resolve_command(ctx, args)
        return self.group.shown(str(name)), found, rest


def execute(command: Command, name: str, given: Any, as_json: bool) -> None:
    """Run a command: check its targets, present its report, write its picture, set the exit code.

    :raises BadParameter: an option's value that is wrong in itself.
    :raises PkmTwinError: what else the command raises, or a file that may not be replaced.
    """
    _check_targets(given)
    drawing = given.drawing(name) if hasattr(given, "drawing") else None
    piped = any(str(path) == STANDARD for path in (getattr(given, "out", None), drawing))
    if drawing is not None:
        refuse_existing(drawing, getattr(given, "overwrite", True), _source(given))
    gc.freeze()
    gc.enable()
    try:
        report = command.run(given)
    except ParameterError as error:
        # Words that the command cannot read; a number that this machine cannot meet is no usage.
        word = error.field.split()[0].removeprefix("--") if error.field else ""
        wrong = [
            _spelled(field, row) for field, kind, row, default in _fields(type(given))
            if getattr(given, field) != default and not row.argument
            and _plain_type(kind)[0] in (str, tuple[str, ...])
        ]  # fmt: skip
        if f"--{word}" not in wrong:
            raise
        raise typer.BadParameter(f"--{str(error).removeprefix('--')}") from None
    if hasattr(given, "drawing"):
        report = _drawn(report, drawing, getattr(given, "overwrite", True))
    present(report, as_json, piped=piped)
    if report.exit_code:
        raise typer.Exit(report.exit_code)


def _drawn(report: Report, drawing: Path | None, overwrite: bool) -> Report:
    """Write the pictures of a report; the first is its ``picture``, ``pictures`` are all.

    :raises PkmTwinError: one of them exists and ``overwrite`` is false: none is written.
    """
    from pkm_twin.report import plots

    if drawing is not None and str(drawing) == STANDARD and len(report.figures) != 1:
        what = f"a file's name, for {len(report.figures)} pictures"
        raise ParameterError("--picture", STANDARD, what)
    targets: dict[Path, Any] = {}
    for suffix, figure in report.figures.items() if drawing is not None else ():
        assert drawing is not None  # noqa: S101  the loop is empty without
        ending = re.sub(r"[^A-Za-z0-9_.-]+", "_", f"_{suffix}" if suffix else "")
        targets[drawing.with_stem(f"{drawing.stem}{ending}")] = figure
    there = [str(target) for target in targets if os.path.lexists(target)]
    if len(there) > 1 and not overwrite:
        raise PkmTwinError(f"{', '.join(there)} exist; use --overwrite to replace them")
    for target in targets:
        refuse_existing(target, overwrite)
    written = [plots.save(figure(), target) for target, figure in targets.items()]
    files = [*written, *(path for name, path in report.files.items() if name == "page" and path)]
    return dataclasses.replace(
        report,
        facts=[*report.facts, Fact("picture", str(written[0]) if written else None),
               Fact("pictures", list(map(str, files)))],
        notes=[*report.notes, *(text for text in map(str, written) if text != STANDARD)],
    )  # fmt: skip


def _check_targets(given: Any) -> None:
    """What a command will write may be written: files of options, and its ``files``.

    :raises PkmTwinError: it may not.
    """
    overwrite, source, more = getattr(given, "overwrite", True), _source(given), []
    for field, _, row, _ in _fields(type(given)):
        target = getattr(given, field)
        if not row.writes or target is None or str(target) == STANDARD:
            continue
        if target.name in ("", ".."):
            what = f"{_spelled(field, row)}: {str(target)!r}"
            raise PkmTwinError(f"{what} is a folder; expected a file name")
        if row.endings and target.suffix not in row.endings:
            raise ParameterError(
                _spelled(field, row), str(target), f"a name that ends in {' or '.join(row.endings)}"
            )
        more.append(target)
    more += getattr(given, "files", {}).values()
    for target in dict.fromkeys(filter(None, more)):
        if os.path.lexists(target) and not overwrite:
            _check_inputs(given)
        refuse_existing(target, overwrite, source)


def _check_inputs(given: Any) -> None:
    """Judge words, files to read and the robot, before an existing target is rejected.

    :raises PkmTwinError: something is.
    """
    for field, _, row, _ in _fields(type(given)):
        value = getattr(given, field)
        for path in value if isinstance(value, tuple) else (value,):
            if row.argument and isinstance(path, Path) and not path.exists():
                raise FileError(path, FileNotFoundError(), "a file to read")
    for check in ("words", "machine"):
        getattr(given, check, lambda: None)()


def _source(given: Any) -> Path | None:
    """The first file that a command reads, which it never replaces."""
    for field, _, row, _ in _fields(type(given)):
        value = getattr(given, field)
        if isinstance(value, Path) and not row.writes:
            return value
    return None


def _fields(given: type[Any]) -> list[tuple[str, Any, Setting, Any]]:
    """Name, type, setting and default of each field, in the order of the help.

    Arguments come first, those of the classes below before the class's own; of options, the
    class's own come first.
    """
    hints, order = hints_of(given), list(given.__mro__)

    def rank(field: str) -> int:
        return next(
            k for k, one in enumerate(order) if field in vars(one).get("__annotations__", {})
        )

    found = [
        (f.name, hints[f.name], f.metadata["setting"], f.default)
        for f in dataclasses.fields(given)
        if "setting" in f.metadata
    ]
    first = [row for row in found if row[2].argument]
    return [
        *sorted(first, key=lambda row: -rank(row[0])),
        *sorted((row for row in found if not row[2].argument), key=lambda row: rank(row[0])),
    ]


def _spelled(field: str, row: Setting) -> str:
    if row.argument:
        return field.upper()
    return f"--{row.name or field.replace('_', '-')}"


def _plain_type(kind: Any) -> tuple[Any, bool]:
    """A type without None, and whether None was there."""
    if get_origin(kind) in (Union, UnionType):
        (rest,) = (one for one in get_args(kind) if one is not type(None))
        return rest, True
    return kind, False


def _parameter(name: str, kind: Any, row: Setting, default: Any) -> inspect.Parameter:
    """A field as a parameter of a function, as typer reads it: numbers and choices are words."""
    bare, optional = _plain_type(kind)
    repeated = get_origin(bare) is tuple and row.count is None
    item = get_args(bare)[0] if repeated else bare
    required = default is dataclasses.MISSING
    metavar = {Path: "FILE", str: "TEXT", int: "COUNT", float: "NUMBER"}.get(item)
    settings: dict[str, Any] = {"help": row.text, "metavar": row.metavar or metavar}
    if row.choices:
        words = list(row.choices)
        settings |= {"autocompletion": lambda: words, "metavar": row.metavar or "|".join(words)}
        default = default if required or default is None else row.parameter(default)
    elif item in (int, float):
        settings["help"] += _bounds(row)
    elif row.count is not None:
        settings["metavar"] = row.metavar or "NUMBERS"
    if not required and default is not None and item not in (bool, str, Path):
        default = list(map(str, default)) if repeated else _written(default)
    word = item if item in (bool, Path) else str
    typed: Any = list[word] if repeated else word  # type: ignore[valid-type]
    settings["show_default"] = not required and default not in (None, "", [])
    if row.argument:
        declared: Any = typer.Argument(**{**settings, "metavar": row.metavar or name.upper()})
    else:
        declared = typer.Option(_spelled(name, row), **settings)
    if repeated and not required:
        # An argument of many words has no other default.
        default, optional = list(default) or None, True
    return inspect.Parameter(
        name,
        inspect.Parameter.KEYWORD_ONLY,
        default=inspect.Parameter.empty if required else default,
        annotation=Annotated[Optional[typed] if optional else typed, declared],  # noqa: UP045
    )


def _written(default: Any) -> str:
    return ",".join(f"{v:g}" for v in default) if isinstance(default, tuple) else str(default)


def _bounds(row: Setting) -> str:
    """The range of a number, where the help does not have it anyway."""
    if row.low is None or row.high is None or row.high >= LARGEST_SHOWN:
        return ""
    return f" [{row.low:g} to {row.high:g}]"


def _taken(field: str, kind: Any, row: Setting, value: Any) -> Any:
    """A field's value for the words that are given.

    :raises BadParameter: they are none.
    """
    bare, optional = _plain_type(kind)
    if value is None:
        return () if get_origin(bare) is tuple and not optional else None
    name = _spelled(field, row)
    if get_origin(bare) is tuple and row.count is None:
        return tuple(_one(name, get_args(bare)[0], row, word) for word in value)
    return _one(name, bare, row, value)


def _one(name: str, kind: Any, row: Setting, word: Any) -> Any:
    if row.choices:
        if word not in row.choices:
            raise typer.BadParameter(f"{name}: {word!r}; expected {' or '.join(row.choices)}")
        return row.value(word)
    if row.count is not None:
        return tuple(numbers(word, row.count, row.metavar or ""))
    if kind not in (int, float):
        # Without the blank before what looks like an option.
        text = str(word)
        return kind(text[1:]) if re.match(r" -\.?\d", text) else word
    try:
        value = decimal(word)
        value = int(word) if kind is int and math.isfinite(value) else value
    except ValueError:
        value = math.nan
    if not (row.allows(value) and math.isfinite(value)):
        what = "a whole number" if kind is int else "a number" + ", no commas" * ("," in word)
        raise typer.BadParameter(f"{name}: {word.strip()!r}; expected {what}{row.span}")
    return value


def _option(words: Sequence[str]) -> bool:
    """Whether the next word is an option, or there is none."""
    return not words or (words[0].startswith("-") and words[0] != STANDARD)


class _Words(TyperCommand):
    """A command that takes negative numbers, older spellings, and a picture without a name."""

    older: dict[str, str]
    usual: set[str]
    """What is so without a word: the opposites of options that begin with no."""

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        # But for what stands before the command's name.
        before = str(ctx.info_name).split()[:-1]
        pieces = (re.sub(r"[{}]", "", piece) for piece in super().collect_usage_pieces(ctx))
        return [piece for piece in pieces if piece not in before]

    def get_params(self, ctx: Any) -> list[Any]:
        """Their help has no types of Python, which some versions of typer show of arguments."""
        found = super().get_params(ctx)
        for one in found:
            if one.param_type_name == "argument":
                vars(one)["display_type_rich"] = lambda **_: None
        return found

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        return super().parse_args(ctx, list(self._plain(args)))

    def _plain(self, args: Sequence[str]) -> Iterator[str]:
        for k, word in enumerate(args):
            if word == "--":
                yield from args[k:]
                return
            if word in self.usual:
                continue
            name, sign, value = word.partition("=")
            name = self.older.get(name, name)
            if _NEGATIVE.match(word):
                # A number is no option; the blank goes when the word is taken.
                yield f" {word}"
            elif word == "--picture" and _option(args[k + 1 : k + 2]):
                yield f"--picture={BESIDE}"
            else:
                yield f"{name}{sign}{value}"
