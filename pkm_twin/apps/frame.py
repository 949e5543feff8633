# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Commands: the fields of a class of settings are options, a function of it gives a report."""

from __future__ import annotations

import dataclasses
import gc
import inspect
import math
import os
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import MISSING
from pathlib import Path
from types import UnionType
from typing import Any, Final, Union, get_args, get_origin
from typing import get_type_hints as hints_of

import click
from click.core import ParameterSource
from click.shell_completion import CompletionItem

from pkm_twin.apps.options import CheckedOptions, DrawingOptions
from pkm_twin.console import parse_count_of_numbers, reject_existing
from pkm_twin.errors import FileError, ParameterError, PkmTwinError, UnknownNameError
from pkm_twin.files import STANDARD, parse_decimal
from pkm_twin.report import Fact, Report
from pkm_twin.report.terminal import present
from pkm_twin.settings import Setting

NEGATIVE_NUMBER: Final = re.compile(r"-\.?\d")
"""Pattern of the beginning of a negative number, which click would read as an option."""
NEGATIVE_MARK: Final = " "
"""Put before a negative number until its value is read, so that click does not read it as an option.
click's ``ignore_unknown_options`` would accept misspelt options as arguments."""


class Value(click.ParamType):  # type: ignore[type-arg]
    """Convert words of the command line to values of a setting, and complete them in the shell."""

    name = "value"

    def __init__(self, kind: Any, row: Setting) -> None:
        """Store the value's type (``kind``: the field's type without None) and the field's setting."""
        self.kind, self.row = kind, row

    def convert(self, value: Any, param: Any, ctx: click.Context | None) -> Any:
        """Convert a word to the field's value.

        :raises UsageError: the word is not one of the choices, not a number, or out of bounds.
        """
        row, name = self.row, format_parameter_name(param)
        word = value[1:] if value[:1] == NEGATIVE_MARK and NEGATIVE_NUMBER.match(value, 1) else value
        if row.choices:
            if word not in row.choices:
                raise click.UsageError(f"{name}: {word!r}; expected {' or '.join(row.choices)}")
            return row.to_field_value(word)
        if row.count is not None:
            return tuple(parse_count_of_numbers(word, row.count, row.metavar or ""))
        if self.kind not in (int, float):
            return self.kind(word)
        try:
            number = parse_decimal(word)
            number = int(word) if self.kind is int and math.isfinite(number) else number
        except ValueError:
            number = math.nan
        if not (row.is_within_bounds(number) and math.isfinite(number)):
            is_integer = self.kind is int
            what = "a whole number" if is_integer else "a number" + ", no commas" * ("," in word)
            raise click.UsageError(f"{name}: {word.strip()!r}; expected {what}{row.bounds_text}")
        return number

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        """Return the choices that begin with a word; the shell completes names of files."""
        if self.kind is Path:
            return [CompletionItem(incomplete, type="file")]
        return [CompletionItem(word) for word in self.row.choices if word.startswith(incomplete)]


class Option(click.Option):
    """Option of a field: also accepts older spellings, and --X as the opposite of --no-X.

    ``shown``: the default's text in the help; empty if there is none.
    """

    def __init__(self, field: str, kind: Any, row: Setting, default: Any) -> None:
        """Read the field's type ``kind``, its setting and default."""
        self.row, self.shown, name = row, "", f"--{row.name or field.replace('_', '-')}"
        kind, repeated = _read_type(kind, row)
        if kind is bool:
            super().__init__([name, field], is_flag=True, help=row.text)
            return
        metavar, text = {Path: "FILE", str: "TEXT", int: "COUNT", float: "NUMBER"}.get(kind), row.text
        if row.choices:
            metavar = "|".join(row.choices)
        elif row.count is not None:
            metavar = "NUMBERS"
        elif kind in (int, float) and row.low is not None and row.high is not None:
            text += f" [{row.low:g} to {row.high:g}]" * (row.high < 1e5)
        self.shown, known = _write_default(row, default)
        if row.alone is not None:
            known |= {"is_flag": False, "flag_value": row.alone}
        super().__init__(
            [name, field],
            type=Value(kind, row),
            metavar=row.metavar or metavar,
            help=text,
            multiple=repeated,
            required=default is MISSING,
            show_default=bool(self.shown),
            **known,
        )

    def add_to_parser(self, parser: Any, ctx: click.Context) -> None:
        """Add the option with its older spellings, which the help does not list."""
        shown, others = self.opts, {name for one in ctx.command.params for name in one.opts}
        self.opts = [*shown, *self.row.older]
        if self.is_flag:
            opposite = {name.replace("--no-", "--") for name in shown if name.startswith("--no-")}
            self.secondary_opts = list(opposite - others)
        super().add_to_parser(parser, ctx)
        self.opts, self.secondary_opts = shown, []


class Argument(click.Argument):
    """Argument of a field, with its text in the help; ``shown``: the default's text there."""

    def __init__(self, field: str, kind: Any, row: Setting, default: Any) -> None:
        """Read the field's type ``kind``, its setting and default."""
        kind, repeated = _read_type(kind, row)
        self.shown, known = _write_default(row, default)
        super().__init__(
            [field], type=Value(kind, row), required=default is MISSING, nargs=-1 if repeated else 1, **known
        )
        self.row = row

    def get_help_record(self, ctx: click.Context) -> tuple[str, str]:
        """Return name and text for the help, which click's own arguments lack."""
        default = f"  [default: {self.shown}]" if self.shown else ""
        return self.human_readable_name, self.row.text + ("  [required]" * self.required or default)


class Command(click.Command):
    """Command that calls ``run`` with an object of a class of settings, whose docstring is the help."""

    def __init__(self, given: type[Any], run: Callable[[Any], Report], task: str = "") -> None:
        """Declare the options of a class of settings.

        :param task: the heading in the list of commands; empty for a command of a group.
        """
        self.given, self.run, self.task = given, run, task
        self.fields = list(_list_parameters(given))
        as_json = click.Option(["--json", "as_json"], is_flag=True, help="print JSON")
        super().__init__(
            run.__name__.replace("_", "-"),
            callback=self.execute,
            params=[*self.fields, as_json],
            help=inspect.cleandoc(given.__doc__ or ""),
        )

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse the words of the command line, marking negative numbers, which are not options."""
        return super().parse_args(ctx, [NEGATIVE_MARK * bool(NEGATIVE_NUMBER.match(w)) + w for w in args])

    def collect_usage_pieces(self, ctx: click.Context) -> list[str]:
        """Return the words of the usage line, without arguments that stand before the command's name."""
        before = str(ctx.info_name).split()[:-1]
        return [piece for piece in super().collect_usage_pieces(ctx) if piece not in before]

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the arguments, then the options, with their texts."""
        records: dict[str, list[tuple[str, str]]] = {"argument": [], "option": []}
        for one in self.get_params(ctx):
            if record := one.get_help_record(ctx):
                records[one.param_type_name].append(record)
        for kind, rows in records.items():
            if rows:
                with formatter.section(f"{kind.capitalize()}s"):
                    formatter.write_dl(rows)

    def execute(self, as_json: bool, **values: Any) -> None:
        """Check the targets, run the command, present its report and write its pictures.

        :raises UsageError: an option has a value that no machine allows.
        :raises PkmTwinError: what else the command raises, or a file that may not be replaced.
        """
        given = self.given(**values)
        overwrite = getattr(given, "overwrite", True)
        read = (getattr(given, str(one.name)) for one in self.fields if not one.row.writes)
        # Never replace the first file that the command reads.
        source = next((value for value in read if isinstance(value, Path)), None)
        self._check_targets(given, overwrite, source)
        drawing = given.drawing(str(self.name)) if isinstance(given, DrawingOptions) else None
        piped = any(str(path) == STANDARD for path in (getattr(given, "out", None), drawing))
        if drawing is not None:
            reject_existing(drawing, overwrite, source)
        gc.freeze()
        gc.enable()
        try:
            report = self.run(given)
        except ParameterError as error:
            # Report an option's text that cannot be parsed as wrong usage, but not a number that this machine
            # does not allow.
            find_source, word = click.get_current_context().get_parameter_source, error.field
            texts = [
                format_parameter_name(one)
                for one in self.fields
                if getattr(one.type, "kind", bool) is str and find_source(str(one.name)) is ParameterSource.COMMANDLINE
            ]
            if not word or f"--{word.split()[0].removeprefix('--')}" not in texts:
                raise
            raise click.UsageError(f"--{str(error).removeprefix('--')}") from None
        if isinstance(given, DrawingOptions):
            report = _write_pictures(report, drawing, overwrite)
        present(report, as_json, piped=piped)
        if report.exit_code:
            raise click.exceptions.Exit(report.exit_code)

    def _check_targets(self, given: Any, overwrite: bool, source: Path | None) -> None:
        """Check that the files of options and of ``given.files`` may be written.

        Files to read, options and the robot are checked before an existing file, so that their
        errors are reported first.

        :raises PkmTwinError: a folder, a wrong ending, or a file that may not be replaced.
        """
        targets = []
        for one in self.fields:
            target, row = getattr(given, str(one.name)), one.row
            if not row.writes or target is None or str(target) == STANDARD:
                continue
            if target.name in ("", ".."):
                what = f"{format_parameter_name(one)}: {str(target)!r}"
                raise PkmTwinError(f"{what} is a folder; expected a file name")
            if row.endings and target.suffix not in row.endings:
                ending = f"a name that ends in {' or '.join(row.endings)}"
                raise ParameterError(format_parameter_name(one), str(target), ending)
            targets.append(target)
        targets += filter(None, getattr(given, "files", {}).values())
        if not overwrite and any(map(os.path.lexists, targets)):
            for one in self.fields:
                value = getattr(given, str(one.name))
                for path in value if isinstance(value, tuple) else (value,):
                    if isinstance(one, Argument) and isinstance(path, Path) and not path.exists():
                        raise FileError(path, FileNotFoundError(), "a file to read")
            if isinstance(given, CheckedOptions):
                given.check_options()
        for target in dict.fromkeys(targets):
            reject_existing(target, overwrite, source)


def command(task: str = "") -> Callable[[Callable[[Any], Report]], Command]:
    """Make a function a command; the class of its one parameter declares the options.

    :param task: the heading in the list of commands.
    """

    def decorate(run: Callable[[Any], Report]) -> Command:
        (given,) = (kind for name, kind in hints_of(run).items() if name != "return")
        return Command(given, run, task)

    return decorate


class Group(click.Group):
    """Group of commands under one name; the error for an unknown command names the closest one."""

    noun = ""
    """Word for a command of the group in errors; by default the group's name."""

    def __init__(
        self,
        name: str,
        text: str,
        commands: Mapping[str, click.Command],
        task: str = "",
        metavar: str = "COMMAND [OPTIONS]",
        **more: Any,
    ) -> None:
        """Set the commands, in the order of the help; ``metavar`` follows the name in the usage line."""
        super().__init__(
            name,
            help=inspect.cleandoc(text),
            subcommand_metavar=metavar,
            no_args_is_help=False,
            options_metavar="[OPTIONS]" if "params" in more else None,
            **more,
        )
        self.commands: Any = commands
        self.task = task

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names of the commands in their order."""
        return list(self.commands)

    def spell_command(self, name: str) -> str:
        """Return a command's name as typed, with the arguments before it."""
        return name

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find the command that the first word names.

        :raises UsageError: there is none.
        """
        name = args[0]
        if name not in self.commands and not name.startswith("-"):
            noun = self.noun or str(ctx.info_name)
            raise click.UsageError(str(UnknownNameError(noun, name, tuple(self.commands))), ctx)
        _, found, rest = super().resolve_command(ctx, args)
        return self.spell_command(name), found, rest


def format_parameter_name(one: click.Parameter) -> str:
    """Return the name of an option or argument as the help prints it."""
    return one.human_readable_name if isinstance(one, click.Argument) else one.opts[0]


def _write_pictures(report: Report, drawing: Path | None, overwrite: bool) -> Report:
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
        reject_existing(target, overwrite)
    written = [plots.save(figure(), target) for target, figure in targets.items()]
    files = [*written, *(path for name, path in report.files.items() if name == "page" and path)]
    return dataclasses.replace(
        report,
        facts=[
            *report.facts,
            Fact("picture", str(written[0]) if written else None),
            Fact("pictures", list(map(str, files))),
        ],
        notes=[*report.notes, *(text for text in map(str, written) if text != STANDARD)],
    )


def _list_parameters(given: type[Any]) -> Iterator[Argument | Option]:
    """Yield the arguments and options of a class of settings, in the order of the help.

    Arguments come first, those of the classes below before the class's own; of options, the
    class's own come first.
    """
    hints, order = hints_of(given), list(given.__mro__)
    rank = {name: k for k, one in reversed([*enumerate(order)]) for name in vars(one).get("__annotations__", {})}
    found = [one for one in dataclasses.fields(given) if "setting" in one.metadata]
    for kind in (Argument, Option):
        sign = -1 if kind is Argument else 1
        for one in sorted(found, key=lambda one: sign * rank[one.name]):
            row = one.metadata["setting"]
            if row.argument == (kind is Argument):
                yield kind(one.name, hints[one.name], row, one.default)


def _read_type(kind: Any, row: Setting) -> tuple[Any, bool]:
    """Return the type of one value, and whether several words give a tuple of values."""
    if get_origin(kind) in (Union, UnionType):
        (kind,) = (one for one in get_args(kind) if one is not type(None))
    repeated = get_origin(kind) is tuple and row.count is None
    return get_args(kind)[0] if repeated else kind, repeated


def _write_default(row: Setting, default: Any) -> tuple[str, dict[str, Any]]:
    """Return a default as text for the help, and as keyword arguments for click."""
    if default in (MISSING, None, ()):
        return "", {}
    if row.choices:
        default = row.to_parameter_value(default)
    elif row.count is not None:
        default = ",".join(f"{value:g}" for value in default)
    elif isinstance(default, tuple):
        return ", ".join(map(str, default)), {"default": list(map(str, default))}
    return str(default), {"default": str(default)}
