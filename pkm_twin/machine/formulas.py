# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Read the parameters of a machine file and the expressions in place of its numbers.

An expression is arithmetic text: + - * / ** ( ), sqrt, sin, cos, tan, atan2, pi and names of
parameters. It is parsed to a syntax tree that may contain only these elements; no code is executed.
"""

from __future__ import annotations

import ast
import difflib
import keyword
import math
import operator
import re
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from graphlib import CycleError, TopologicalSorter
from typing import Any, Final

from pkm_twin.codegen import operations
from pkm_twin.codegen.expressions import reference
from pkm_twin.errors import ParameterError, unknown_number_error

PARAMETERS: Final = "parameters"
"""Name of the parameters' section, the first key of their paths."""
MAX_LENGTH: Final = 500
"""Longest expression, characters."""
MAX_DEPTH: Final = 40
"""Deepest nesting of an expression."""
MAX_SIZE: Final = 1e18
"""Largest number: beyond every quantity of a machine in SI units; products stay finite."""
_NAME_PATTERN: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_NUMBER_PATTERN: Final = re.compile(r"(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")


def _dispatch(numbers: Callable[..., float], expressions: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that calls ``expressions`` if an argument is one, else ``numbers``."""

    def call(*values: Any) -> Any:
        if any(hasattr(value, "tape") for value in values):
            return expressions(*values)
        return numbers(*values)

    return call


def _raise_expression(base: Any, exponent: Any) -> Any:
    """Raise an expression to a power: by products for an integer exponent, else by exp and log."""
    fixed = None if hasattr(exponent, "tape") else float(exponent)
    if fixed is not None and fixed.is_integer() and abs(fixed) <= MAX_DEPTH:
        product = base ** int(abs(fixed)) if fixed else 1.0
        return product if fixed >= 0.0 else 1.0 / product
    own = reference(base)
    # A step of Halley's method changes a logarithm by at most 2: begin with the 256th root.
    ratio = base / own
    root = ratio
    for _ in range(8):
        root = operations.sqrt(root)
    log = _halley_logarithm(ratio, 256.0 * _halley_logarithm(root, 0.0, 4), 2)
    return operations.exp(exponent * (math.log(own) + log))


def _halley_logarithm(value: Any, log: Any, steps: int) -> Any:
    """Compute a logarithm by Halley's third-order method for exp(log) = value."""
    for _ in range(steps):
        power = operations.exp(log)
        log = log + 2.0 * (value - power) / (value + power)
    return log


FUNCTIONS: Final[Mapping[str, tuple[int, Callable[..., Any]]]] = {
    "sqrt": (1, _dispatch(math.sqrt, operations.sqrt)),
    "sin": (1, _dispatch(math.sin, operations.sin)),
    "cos": (1, _dispatch(math.cos, operations.cos)),
    "tan": (1, _dispatch(math.tan, lambda x: operations.sin(x) / operations.cos(x))),
    "atan2": (2, _dispatch(math.atan2, operations.atan2)),
}
"""Functions of expressions: number of arguments, and implementation."""
_OPERATORS: Final[Mapping[type, Callable[..., Any]]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: _dispatch(operator.pow, _raise_expression),
    ast.USub: operator.neg,
    ast.UAdd: lambda x: x,
}


@dataclass(frozen=True, eq=False)
class Formula:
    """A checked expression; ``path``: its path in the file; ``names``: its parameters."""

    path: str
    text: str
    tree: ast.expr
    names: frozenset[str]

    @classmethod
    def of(cls, path: str, text: str) -> Formula:
        """Parse and check an expression.

        :raises ParameterError: the text is not arithmetic, too long or nested too deep.
        """
        if len(text) > MAX_LENGTH:
            raise ParameterError(path, text, f"at most {MAX_LENGTH} characters")
        if strange := re.search(r"[^A-Za-z0-9_ \t.+\-*/(),]", text):
            raise ParameterError(path, text, f"arithmetic; {strange[0]!r} is no part of it")
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                tree = ast.parse(text.strip(), mode="eval").body
        except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
            told = error.msg if isinstance(error, SyntaxError) else "too deep"
            if re.fullmatch(r"\s*[-+]?[\d.]+([eE][-+]?\d+)?\s*[A-Za-z]\S*\s*", text):
                raise ParameterError(path, text, "a number without unit, rad and m") from None
            raise ParameterError(path, text, f"arithmetic; {told}") from None
        names = set[str]()
        nodes = [(tree, 1)]
        while nodes:
            node, depth = nodes.pop()
            if depth > MAX_DEPTH:
                raise ParameterError(path, text, f"a nesting of at most {MAX_DEPTH}")
            if reason := _find_invalid_reason(node, text.strip()):
                raise ParameterError(path, text, reason)
            if isinstance(node, ast.Name) and node.id != "pi":
                names.add(node.id)
            nodes += [(part, depth + 1) for part in _child_nodes(node)]
        return cls(path, text, tree, frozenset(names))

    def value(self, given: Mapping[str, Any]) -> Any:
        """Evaluate the expression for parameters that are numbers or expressions of programs.

        :raises ParameterError: a parameter is unknown, or the result is not a finite number.
        """
        for name in sorted(self.names - given.keys()):
            if name.lower() in ("nan", "inf"):
                raise self._make_error("a finite number")
            close = difflib.get_close_matches(name, [*given, *FUNCTIONS, "pi"], 1)
            hint = f"; did you mean {close[0]!r}?" if close else ""
            raise self._make_error(f"names under `{PARAMETERS}`; {name!r} is none{hint}")
        try:
            found = _evaluate(self.tree, given)
        except ZeroDivisionError:
            raise self._make_error("a finite number, not a division by zero") from None
        except FloatingPointError:
            raise self._make_error(f"0, or at least {sys.float_info.min:.1e} in size") from None
        except (ValueError, OverflowError, TypeError):
            raise self._make_error("a finite real number") from None
        if hasattr(found, "tape"):
            return found
        if isinstance(found, complex) or not abs(found) <= MAX_SIZE:
            raise self._make_error("a finite real number")
        return float(found)

    def _make_error(self, reason: str) -> ParameterError:
        return ParameterError(self.path, self.text, reason)

    def units(self, unit: str) -> Iterator[tuple[str, str]]:
        """Derive units of parameters, where possible, from the unit of the expression's value."""
        return _derive_units(self.tree, unit)


def _child_nodes(node: ast.expr) -> list[ast.expr]:
    """Return the operands or arguments of a node."""
    if isinstance(node, ast.BinOp):
        return [node.left, node.right]
    if isinstance(node, ast.UnaryOp):
        return [node.operand]
    return node.args if isinstance(node, ast.Call) else []


def _find_invalid_reason(node: ast.expr, text: str) -> str:
    """Return why a node is not allowed in an expression; empty if it is allowed."""
    own = text[node.col_offset : node.end_col_offset]
    if isinstance(node, ast.Name):
        return f"{own}( )" if own in FUNCTIONS else ""
    if isinstance(node, ast.Constant):
        if not _NUMBER_PATTERN.fullmatch(own):
            return f"decimal numbers; {own!r} is none"
        lost = not float(own) and re.match(r"[0.]*[1-9]", own)
        return f"0, or at least {sys.float_info.min:.1e} in size" if lost else ""
    if isinstance(node, (ast.BinOp, ast.UnaryOp)) and type(node.op) in _OPERATORS:
        return ""
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
        called = node.func.id
        if called in FUNCTIONS and not node.keywords and len(node.args) == FUNCTIONS[called][0]:
            return ""
        if called in FUNCTIONS:
            count = FUNCTIONS[called][0]
            return f"{called} of {count} number{'s' * (count > 1)}"
        return f"functions {', '.join(FUNCTIONS)}; {called!r} is none"
    return f"+ - * / ** ( ) and {', '.join(FUNCTIONS)}, not {own!r}"


def _evaluate(node: ast.expr, given: Mapping[str, Any]) -> Any:
    if isinstance(node, ast.Constant):
        return float(node.value)  # type: ignore[arg-type]
    if isinstance(node, ast.Name):
        return math.pi if node.id == "pi" else given[node.id]
    values = [_evaluate(part, given) for part in _child_nodes(node)]
    if isinstance(node, ast.Call):
        return FUNCTIONS[node.func.id][1](*values)  # type: ignore[attr-defined]
    found = _OPERATORS[type(node.op)](*values)  # type: ignore[attr-defined]
    products = isinstance(node, ast.BinOp) and isinstance(node.op, (ast.Mult, ast.Div, ast.Pow))
    if products and isinstance(found, float) and not found and all(values):
        raise FloatingPointError
    return found


def _derive_units(node: ast.expr, unit: str) -> Iterator[tuple[str, str]]:
    if isinstance(node, ast.Name) and node.id != "pi" and unit and not unit.endswith("^2"):
        yield node.id, unit
    parts = _child_nodes(node)
    if isinstance(node, ast.Call):
        called = node.func.id  # type: ignore[attr-defined]
        # The argument of a root has the squared unit.
        angles = called in ("sin", "cos", "tan")
        inner = "rad" if angles else f"{unit}^2" if called == "sqrt" and unit else ""
        for part in parts:
            yield from _derive_units(part, inner)
    elif isinstance(node, ast.BinOp) and isinstance(node.op, ast.Pow):
        squared = isinstance(parts[1], ast.Constant) and parts[1].value == 2
        yield from _derive_units(parts[0], unit.removesuffix("^2") if squared else "")
    elif isinstance(node, ast.BinOp) and isinstance(node.op, (ast.Mult, ast.Div)):
        # A factor has the unit of the product if the other factor has none.
        bare = [_has_no_unit(part) for part in parts]
        yield from _derive_units(parts[0], unit if bare[1] else "")
        yield from _derive_units(parts[1], unit if isinstance(node.op, ast.Mult) and bare[0] else "")
    else:
        for part in parts:
            yield from _derive_units(part, unit)


def _has_no_unit(node: ast.expr) -> bool:
    """Return whether an expression contains only numbers, pi and angle functions (no unit)."""
    if isinstance(node, ast.Name):
        return node.id == "pi"
    if isinstance(node, ast.Call) and node.func.id in ("sin", "cos", "tan"):  # type: ignore[attr-defined]
        return True
    return all(map(_has_no_unit, _child_nodes(node)))


class ExpressionText(str):
    """A text in a machine file that may be an expression in place of a number."""

    book: Book
    place: str

    @classmethod
    def from_text(cls, text: str, book: Book, place: str = "") -> ExpressionText:
        """Make the text of a file with these parameters; ``place``: suffix of the number's path."""
        made = cls(text)
        made.book, made.place = book, place
        return made

    def number(self, path: str) -> float:
        """Evaluate the expression and record it at the path of its number.

        :raises ParameterError: the text is not arithmetic, or its result is not finite.
        """
        formula = Formula.of(path + self.place, str(self))
        self.book.formulas[formula.path] = formula
        return float(formula.value(self.book.values))


@dataclass(frozen=True, eq=False)
class Book:
    """The parameters of a file in the order of their dependence, and all expressions.

    ``values``: of the parameters, by name. ``own``: expressions of parameters, by name.
    ``formulas``: expressions of other numbers, by path. ``data``: the file's content; empty if
    numbers were changed since it was read.
    """

    values: Mapping[str, Any] = field(default_factory=dict)
    own: Mapping[str, Formula] = field(default_factory=dict)
    formulas: dict[str, Formula] = field(default_factory=dict)
    data: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def of(cls, data: Mapping[str, Any]) -> Book:
        """Read the parameters of a file.

        :raises ParameterError: a name or value is invalid, or parameters depend on each other in a
            circle.
        """
        given = data.get(PARAMETERS)
        if given is None:
            given = {}
        if not isinstance(given, Mapping):
            raise ParameterError(PARAMETERS, given, "a mapping of names to numbers")
        own: dict[str, Formula] = {}
        for name, value in given.items():
            path = f"{PARAMETERS}.{name}"
            taken = name in FUNCTIONS or name == "pi" or keyword.iskeyword(str(name))
            if taken or not isinstance(name, str) or not _NAME_PATTERN.fullmatch(name):
                raise ParameterError(path, name, "a name of letters, digits and _, not in use")
            if isinstance(value, str):
                own[name] = Formula.of(path, value)
            elif isinstance(value, bool) or not isinstance(value, int | float):
                raise ParameterError(path, value, "a number or an expression")
            elif not abs(value) <= MAX_SIZE:
                raise ParameterError(path, value, "a finite number")
        graph = {name: own[name].names & given.keys() if name in own else () for name in given}
        try:
            order = tuple(TopologicalSorter(graph).static_order())
        except CycleError as error:
            circle = error.args[1][::-1]
            path = f"{PARAMETERS}.{circle[0]}"
            reason = f"no circle: {', '.join(circle)}"
            raise ParameterError(path, own[circle[0]].text, reason) from None
        numbers = {name: given[name] for name in order if name not in own}
        return cls(dict.fromkeys(order, 0.0), own, {}, data)._replace_numbers(numbers)

    def mark_expressions(self, data: Any) -> Any:
        """Convert all texts of data to :class:`ExpressionText`, so that they may be expressions."""
        if isinstance(data, Mapping):
            return {name: self.mark_expressions(value) for name, value in data.items()}
        if isinstance(data, list):
            return [self.mark_expressions(value) for value in data]
        return ExpressionText.from_text(data, self) if isinstance(data, str) else data

    def _replace_numbers(self, numbers: Mapping[str, Any]) -> Book:
        """Return the book with numbers in place of some parameters."""
        own = {name: formula for name, formula in self.own.items() if name not in numbers}
        values: dict[str, Any] = {}
        for name, old in self.values.items():
            new = numbers.get(name, old)
            values[name] = own[name].value(values) if name in own else new
            if not hasattr(values[name], "tape"):
                values[name] = float(values[name])
        return replace(self, values=values, own=own)

    def change_numbers(self, values: Mapping[str, Any]) -> tuple[Book, dict[str, Any]]:
        """Change numbers and parameters by path; return the book and all numbers that change.

        :raises ParameterError: a parameter does not exist, or a result is not finite.
        """
        start = f"{PARAMETERS}."
        new = {path[len(start) :]: v for path, v in values.items() if path.startswith(start)}
        rest = {path: v for path, v in values.items() if not path.startswith(start)}
        kept = {path: one for path, one in self.formulas.items() if path not in rest}
        for name in new.keys() - self.values.keys():
            raise unknown_number_error(start + name, [start + known for known in self.values])
        if not values:
            return self, rest
        book = replace(self._replace_numbers(new), formulas=kept, data={})
        return book, {**{one.path: one.value(book.values) for one in book.list_dependent(new)}, **rest}

    def replace_sections(self, sections: Mapping[str, Any]) -> Book:
        """Return the book of the file with other sections, without their expressions."""
        kept = {path: f for path, f in self.formulas.items() if path.split(".")[0] not in sections}
        data = {**self.data, **sections} if sections and self.data else {}
        return replace(self, formulas=kept, data=data)

    def list_dependent(self, names: Iterable[str]) -> list[Formula]:
        """List the numbers that depend, directly or not, on some parameters."""
        moving = set(names)
        for name in self.values:
            if name in self.own and self.own[name].names & moving:
                moving.add(name)
        # Uncertainties and tolerances keep the values of the file.
        moved = (one for one in self.formulas.values() if one.names & moving)
        return [one for one in moved if not one.path.startswith(("uncertainty.", "tolerances."))]

    def text(self, path: str) -> str:
        """Return the expression at a path; empty for a plain number."""
        found = self.own.get(path.partition(f"{PARAMETERS}.")[2]) or self.formulas.get(path)
        return found.text if found else ""

    def describe_lost(self, other: Book) -> list[str]:
        """Describe the expressions and dependences that are lost in another book, in up to two lines."""
        texts = [f"{path} was {formula.text}" for path, formula in self.formulas.items() if path not in other.formulas]
        kept = other.values.keys() - other.unused
        dead = [name for name in self.values if name not in kept and name not in self.unused]
        lines = [f"numbers replace expressions: {', '.join(texts)}"] if texts else []
        return lines + ([f"nothing depends on {', '.join(dead)} any more"] if dead else [])

    @property
    def unused(self) -> list[str]:
        """Parameters that no expression uses."""
        used = {n for one in (*self.own.values(), *self.formulas.values()) for n in one.names}
        return [name for name in self.values if name not in used]

    def describe(self, units: Mapping[str, str] | None = None) -> list[str]:
        """Describe each parameter: value, unit and expression."""
        return [
            f"{name} = {value:.12g} {(units or {}).get(name, '')}".strip()
            + (f" = {self.own[name].text}" if name in self.own else "")
            + ("; nothing depends on it" if name in self.unused else "")
            for name, value in self.values.items()
        ]

    def units(self, given: Mapping[str, str]) -> dict[str, str]:
        """Derive the units of the parameters; empty if unknown or contradictory.

        :param given: units of the file's numbers by path.
        """
        found: dict[str, set[str]] = {name: set() for name in self.values}
        for path, formula in self.formulas.items():
            for name, unit in formula.units(given.get(path, "")):
                found[name].add(unit)
        for name in reversed(list(self.values)):
            if name in self.own and len(found[name]) == 1:
                for other, unit in self.own[name].units(*found[name]):
                    found[other].add(unit)
        return {name: units.pop() if len(units) == 1 else "" for name, units in found.items()}
