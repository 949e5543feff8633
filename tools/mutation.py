# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Break one rule at a time and see whether a test fails: ``make mutation``.

A mutant is a module with one operator, number or statement changed. It is compiled in a process of
its own, which then runs the tests named for the module; the tree stays as it is.
"""

from __future__ import annotations

import argparse
import ast
import os
import random
import signal
import sys
import tempfile
from collections.abc import Iterator
from importlib.machinery import SourceFileLoader
from pathlib import Path

import pytest
import scipy.optimize  # Loaded once, for all mutants.  # noqa: F401

TARGETS = {
    "delta_dynamics/gate.py": "nodes:gate nodes:joint_map",
    "pkm_twin/streams/monitor.py": "nodes:gate nodes:streams nodes:monitor nodes:feedforward",
    "pkm_twin/messages/stamps.py": "nodes:messages nodes:gate nodes:feedforward",
    "pkm_twin/messages/reading.py": "nodes:messages nodes:gate nodes:joint_map nodes:wrenches "
    "nodes:fast_decoder nodes:stiffness_watch nodes:feedforward",
    "pkm_twin/codegen/program.py": "laws:newton laws:assemblies nodes:feedforward_singularities docs:constants",
}
"""Module, and the tests that judge it."""
SWAPS: dict[type, type] = {
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
    ast.And: ast.Or,
    ast.Or: ast.And,
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
}
PLAIN = (ast.Expr, ast.Assign, ast.AugAssign, ast.Raise)
"""Statements that are left out."""


def mutants(node: ast.AST) -> Iterator[tuple[str, ast.AST]]:
    """Yield changed versions of a syntax node, with names."""

    def changed(**fields: object) -> ast.AST:
        own = dict(ast.iter_fields(node))
        return ast.copy_location(type(node)(**own | fields), node)

    if isinstance(node, ast.Compare):
        for k, op in enumerate(node.ops):
            if type(op) in SWAPS:
                yield "compare", changed(ops=[*node.ops[:k], SWAPS[type(op)](), *node.ops[k + 1 :]])
    elif isinstance(node, (ast.BoolOp, ast.BinOp, ast.AugAssign)) and type(node.op) in SWAPS:
        yield "operator", changed(op=SWAPS[type(node.op)]())
    elif isinstance(node, ast.UnaryOp):
        yield "without sign", node.operand
    elif isinstance(node, ast.Constant) and isinstance(node.value, (bool, int, float)):
        value = node.value
        yield "constant", changed(value=not value if isinstance(value, bool) else value * 2 + 1)
    elif isinstance(node, (ast.If, ast.IfExp)):
        yield "always", changed(test=ast.Constant(True))
        yield "never", changed(test=ast.Constant(False))
    if isinstance(node, PLAIN) and not isinstance(getattr(node, "value", None), ast.Constant):
        yield "left out", ast.copy_location(ast.Pass(), node)


class Walk(ast.NodeTransformer):
    """Count the places of change that tests reach, and change one of them."""

    def __init__(self, chosen: int | None = None) -> None:
        self.chosen, self.places = chosen, list[str]()

    def generic_visit(self, node: ast.AST) -> ast.AST:
        if isinstance(node, ast.FunctionDef):
            node.returns = None  # Annotations do not change behaviour.
        if isinstance(node, ast.AnnAssign):
            node.value = node.value and self.visit(node.value)
            return node
        for name, new in mutants(node):
            self.places.append(f"{node.lineno} {name}: {ast.unparse(node).splitlines()[0]}"[:100])
            if self.chosen == len(self.places) - 1:
                return new
        return super().generic_visit(node)

    def visit_ClassDef(self, node: ast.ClassDef) -> ast.AST:
        node.body = [self.visit(part) for part in node.body]  # Decorators of classes (frozen) do not change behaviour.
        return node

    def visit_arguments(self, node: ast.arguments) -> ast.AST:
        node.defaults = [self.visit(default) for default in node.defaults]
        return node

    def visit_JoinedStr(self, node: ast.JoinedStr) -> ast.AST:
        return node  # Texts of messages are not tested.

    def visit_Call(self, node: ast.Call) -> ast.AST:
        # Settings are tested by the tests of the pages, in their own processes.
        return node if ast.unparse(node.func) in ("setting", "TypeVar") else self.generic_visit(node)


def survives(path: str, chosen: int, tests: list[str]) -> bool:
    """Return whether all tests pass with a change; a timeout counts as found."""
    child = os.fork()
    if not child:
        signal.alarm(900)
        name = path.removesuffix(".py").replace("/", ".")
        tree = Walk(chosen).visit(ast.parse(Path(path).read_text(encoding="utf-8")))
        code = compile(ast.fix_missing_locations(tree), path, "exec")
        read = SourceFileLoader.get_code
        SourceFileLoader.get_code = lambda own, asked: code if asked == name else read(own, asked)
        for stream in (1, 2):
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
        with tempfile.TemporaryDirectory() as folder:
            # Use another cache for programs of a changed compiler.
            if "codegen" in path:
                os.environ["PKM_TWIN_CACHE"] = folder
            options = ["-x", "-q", "-p", "no:cacheprovider", "-p", "no:xdist"]
            # The first test file finds most mutants; the others are then skipped.
            failed = any(pytest.main([*options, test]) not in (0, 5) for test in tests)
        os._exit(failed)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


def main() -> int:
    """Print each survivor and the fraction of mutants that is found."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("paths", nargs="*", default=[*TARGETS])
    parser.add_argument("--most", type=int, default=60, help="mutants per module, drawn at random")
    parser.add_argument("--only", type=int, nargs="*", help="numbers of mutants, in one module")
    options = parser.parse_args()
    sys.path[:0] = [".", "test"]
    for path in options.paths:
        tests = [f"test/{test.replace(':', '/test_')}.py" for test in TARGETS[path].split()]
        walk = Walk()
        walk.visit(ast.parse(Path(path).read_text(encoding="utf-8")))
        drawn = options.only or range(len(walk.places))
        if len(drawn) > options.most:
            drawn = sorted(random.Random(1).sample(drawn, options.most))
        if not survives(path, -1, tests):
            raise SystemExit(f"{path}: the tests fail without a change")
        lived = 0
        for k in drawn:
            if survives(path, k, tests):
                print(f"{path} [{k}] line {walk.places[k]}", flush=True)
                lived += 1
        print(f"{path}: {len(drawn) - lived} of {len(drawn)} found", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
