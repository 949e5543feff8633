# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Typed errors: each carries the value and the bound, as text and as attributes; and warnings."""

from __future__ import annotations

import difflib
import importlib
import sys
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, TextIO


class PkmTwinError(Exception):
    """Base of all errors that pkm_twin raises for invalid input."""

    salvageable: int = 0
    """Number of intact messages that ``pkm-twin recover`` can save from a damaged bag."""


class ParameterError(PkmTwinError, ValueError):
    """An invalid file, key or value.

    ``field`` is the dotted name, ``value`` the given value, ``bound`` what is expected.
    """

    def __init__(self, field: str, value: object, bound: str) -> None:
        found = "missing" if value is None else shorten_value(value)
        super().__init__(one_line(f"{field}: {found}; expected {bound}", 2000))
        self.field = field
        self.value = value
        self.bound = bound


class FileError(ParameterError):
    """A file that cannot be read or has another format.

    ``bound`` is the expected format, such as "a CSV file".
    """

    def __init__(self, path: str | Path, error: Exception, bound: str) -> None:
        missing = isinstance(error, FileNotFoundError)
        system = error.strerror if isinstance(error, OSError) else None
        what = " ".join((system or str(error)).split()) or type(error).__name__
        super().__init__(str(path), what, bound)
        wanted = f"no such file; expected {bound}"
        text = wanted if missing else what if system else f"not {bound}: {what}"
        self.args = (one_line(f"{path}: {text}", 2000),)


MAX_LISTED_NAMES: Final = 60
"""Largest number of valid names that an error lists; with more names it lists the closest ones."""


class UnknownNameError(ParameterError):
    """A key or name that does not exist.

    ``valid`` are the valid names, ``closest`` is the nearest of them, or None.
    """

    def __init__(self, field: str, name: object, valid: Iterable[str]) -> None:
        names = sorted(valid)
        match = difflib.get_close_matches(str(name), names, n=1, cutoff=0.5)
        self.closest: str | None = match[0] if match else None
        shown, more = names, ""
        if len(names) > MAX_LISTED_NAMES:
            shown = difflib.get_close_matches(str(name), names, n=5, cutoff=0.0)
            more = f" or {len(names) - len(shown)} others"
        super().__init__(field, name, f"one of {', '.join(shown)}{more}")
        self.valid = names
        if field == str(name) or field.endswith(f".{name}"):
            what = f"unknown key {field!r}"
        elif field in ("robot", "mechanism", "map", "launch argument", "command"):
            what = f"unknown {field} {shorten_value(name)}"
        else:
            what = f"{field}: {shorten_value(name)}"
        hint = f"did you mean {self.closest!r}? " if self.closest else ""
        self.args = (one_line(f"{what}; {hint}expected {self.bound}", 2000),)


def unknown_number_error(path: str, names: Iterable[str]) -> ParameterError:
    """Return the error for a path that names no number of the file; it lists the closest paths."""
    known = list(names)
    # Suggest paths that contain the given one, first those that end with it; otherwise similar spellings.
    close = [n for n in known if f".{path}.".replace("[", ".[") in f".{n}.".replace("[", ".[")]
    close = sorted(close, key=lambda name: not name.endswith(path))
    close = close[:3] or difflib.get_close_matches(path, known, 1)
    hint = f"did you mean {' or '.join(map(repr, close))}? see" if close else "see"
    return ParameterError(path, None, f"a number of the robot's file; {hint} `pkm-twin info`")


class MobilityError(ParameterError):
    """A machine whose number of actuated joints differs from its degrees of freedom.

    ``actuated`` and ``freedoms`` are the two numbers; ``causes`` are texts, the likeliest first.
    """

    def __init__(self, actuated: int, freedoms: int, causes: Sequence[str]) -> None:
        super().__init__("joints", freedoms, f"a mobility of {actuated}")
        self.actuated, self.freedoms, self.causes = actuated, freedoms, tuple(causes)
        joints = f"{actuated} actuated joint{'' if actuated == 1 else 's'}"
        degrees = f"{freedoms} degree{'' if freedoms == 1 else 's'} of freedom"
        self.args = (one_line(f"joints: {joints} for {degrees}; {'; '.join(causes)}", 2000),)


class RobotWarning(UserWarning):
    """An implausible number in a robot's file; the file is used as it is."""


_warned: dict[str, dict[Any, Any]] = {}
"""The warnings given for each file, so that a file that is loaded again does not repeat them."""


MIN_LIMIT: Final = 1e-9
"""Smallest limit that a machine can have, in any unit."""


def check_limit(field: str, value: float, unit: str = "", least: float = MIN_LIMIT, most: float = 1e12) -> None:
    """Reject NaN and values out of range; by default also zero and below.

    :raises ParameterError: the value is invalid; the error names the field.
    """
    if not least <= value <= most:
        raise ParameterError(field, value, f"{least:g} to {most:g} {unit}".strip())


def warn_of_file(path: str | Path, text: str) -> None:
    """Warn about a robot's file; the warning names the file, not a line of the program."""
    known = _warned.setdefault(str(path), {})
    warnings.warn_explicit(text, RobotWarning, str(path), 0, registry=known)


@contextmanager
def plain_warnings() -> Iterator[None]:
    """Print warnings about a robot's file as one line on stderr, without a line of the program."""
    default_show = warnings.showwarning

    def show_warning(
        message: Warning | str,
        category: type[Warning],
        filename: str,
        lineno: int,
        file: TextIO | None = None,
        line: str | None = None,
    ) -> None:
        if issubclass(category, RobotWarning):
            print(one_line(f"warning: {filename}: {message}", 2000), file=file or sys.stderr)
        else:
            default_show(message, category, filename, lineno, file, line)

    warnings.showwarning = show_warning
    try:
        yield
    finally:
        warnings.showwarning = default_show


class UnreachableError(PkmTwinError, ValueError):
    """A pose or joint state in which the mechanism cannot be assembled.

    ``limb`` is the name of the limb or joint, ``index`` the sample's index in the batch (``()`` for
    one sample), ``miss`` the gap that remains (m), ``reached`` the fraction of the straight line
    from home up to which there is an assembly, None if no line was followed.
    ``question``: text about a coordinate far outside the machine and the unit that it may have, shown
    instead of limb and gap. ``how``: reason why the limb cannot be placed, shown instead of the gap.
    """

    def __init__(
        self,
        what: str,
        limb: str,
        index: tuple[int, ...],
        miss: float,
        reached: float | None = None,
        question: str = "",
        how: str = "",
    ) -> None:
        where = f" at sample {index if len(index) != 1 else index[0]}" if index else ""
        way = "" if reached is None else f", beyond {100 * reached:.3g} % of the way from home"
        # A limb of length zero has no gap and no direction.
        gap = f"misses by {miss:.6g} m" if miss else "has no direction there"
        text = f" is unreachable: {limb} {how or gap}{way}"
        super().__init__(f"{what}{where}{question or text}")
        self.reached = reached
        self.limb = limb
        self.index = index
        self.miss = miss
        self.how = how


class SingularityError(PkmTwinError, ValueError):
    """A pose at or beyond a singularity.

    ``measure`` is the dimensionless reciprocal condition number, ``bound`` the least valid one;
    ``reached`` the fraction of the straight line from home at which the singularity occurs, None at
    the pose itself; ``beyond``: true if the pose is on the other side of a singularity; ``question``:
    the coordinate that is far outside the machine and the unit it may have, instead of all else.
    """

    def __init__(
        self,
        what: str,
        index: tuple[int, ...],
        measure: float,
        bound: float,
        reached: float | None = None,
        beyond: bool = False,
        question: str = "",
    ) -> None:
        where = f" at sample {index if len(index) != 1 else index[0]}" if index else ""
        if question:
            text = question
        elif beyond:
            text = " lies beyond a singularity: its joint positions assemble the machine elsewhere"
        elif reached is None:
            text = f" is singular: reciprocal condition {measure:.3g} is below {bound:.3g}"
        else:
            text = f" lies beyond a singularity, which the straight path from home meets at {100 * reached:.3g} %"
        super().__init__(f"{what}{where}{text}")
        self.reached, self.beyond = reached, beyond
        self.index = index
        self.measure = measure
        self.bound = bound


class MessageError(PkmTwinError, ValueError):
    """A ROS message that is rejected.

    ``reason`` is a short stable code for counting; the text contains values and bounds.
    """

    def __init__(self, reason: str, text: str) -> None:
        super().__init__(text)
        self.reason = reason

    @property
    def labelled(self) -> str:
        """The text with its reason in front, unless the text begins with it."""
        return label_reason(self.reason, str(self))


def label_reason(reason: str, text: str) -> str:
    """Return a text with its reason in front, unless the text begins with it."""
    return text if text.startswith(f"{reason}: ") else f"{reason}: {text}"


class BagError(PkmTwinError):
    """A bag that cannot be read or written.

    ``reason`` is a short stable code, ``offset`` the byte in the file, if known.
    """

    def __init__(
        self, message: str, *, path: str | Path | None = None, reason: str = "damaged", offset: int | None = None
    ) -> None:
        where = f"{path}: " if path is not None else ""
        at = f" (byte {offset})" if offset is not None else ""
        super().__init__(f"{where}{one_line(message)}{at}")
        self.path = None if path is None else Path(path)
        self.reason = reason
        self.offset = offset


def one_line(text: str, limit: int = 400) -> str:
    """Shorten a text to one line: escape unprintable characters, cut the middle.

    ``limit`` is the largest number of characters of the result.
    """
    # Cut before escaping, which may turn each character into ten.
    half = limit // 2
    if len(text) > 2 * limit:
        text = f"{text[:limit]}{text[-limit:]}"
    shown = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)
    return shown if len(shown) <= limit else f"{shown[: half - 5]} ... {shown[5 - half :]}"


def shorten_value(value: object, limit: int = 80) -> str:
    """Write a value for an error message, without numpy's types and at most ``limit`` characters."""
    if isinstance(value, Exception):
        return str(value)
    text = repr(_convert_from_numpy(value))
    return text if len(text) <= limit else text[: limit - 3] + "..."


def _convert_from_numpy(value: Any) -> Any:
    """Convert numpy's types, which ``repr`` would name, to Python's."""
    if type(value).__module__ == "numpy" and hasattr(value, "tolist"):
        return value.tolist()
    if type(value) in (list, tuple):
        return type(value)(map(_convert_from_numpy, value))
    if type(value) is dict:
        return {_convert_from_numpy(key): _convert_from_numpy(one) for key, one in value.items()}
    return value


def write_install_command(extra: str) -> str:
    """Return the command that installs an extra from a clone; no package index has pkm_twin."""
    return f"pip install '.[{extra}]' in a clone of pkm_twin"


class MissingExtraError(PkmTwinError, ImportError):
    """A package that is not installed; ``extra``: the extra of pkm_twin that installs it."""

    def __init__(self, package: str, extra: str) -> None:
        super().__init__(f"{package} is not installed; {write_install_command(extra)} brings it")
        self.package = package
        self.extra = extra


def import_extra(module: str, extra: str) -> Any:
    """Import a module of an extra.

    :raises MissingExtraError: the module is not installed; the error names the extra.
    """
    try:
        return importlib.import_module(module)
    except ImportError:
        raise MissingExtraError(module.partition(".")[0], extra) from None
