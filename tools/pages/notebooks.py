# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Run notebooks and store what they show: ``python -m tools.pages.notebooks FILE...``."""

from __future__ import annotations

import ast
import base64
import contextlib
import io
import json
import sys
from pathlib import Path
from typing import Any

import matplotlib

DPI = 70


def run(cells: list[dict[str, Any]]) -> list[tuple[str, list[bytes]]]:
    """Run the code cells; return what each prints, its last expression, and its pictures."""
    matplotlib.use("Agg")
    from matplotlib import pyplot

    space: dict[str, Any] = {"__name__": "__main__"}
    found = []
    for cell in (cell for cell in cells if cell["cell_type"] == "code"):
        source = "".join(cell["source"])
        tree = ast.parse(source)
        last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
        with contextlib.redirect_stdout(io.StringIO()) as printed:
            exec(compile(tree, "cell", "exec"), space)
            if isinstance(last, ast.Expr):
                value = eval(compile(ast.Expression(last.value), "cell", "eval"), space)
                # As in a notebook, a semicolon hides the value.
                if value is not None and not source.rstrip().endswith(";"):
                    print(value)
        pictures = []
        for number in pyplot.get_fignums():
            buffer = io.BytesIO()
            pyplot.figure(number).savefig(buffer, dpi=DPI, metadata={"Software": None})
            pictures.append(buffer.getvalue())
        pyplot.close("all")
        found.append((printed.getvalue(), pictures))
    return found


def text_of(cell: dict[str, Any]) -> str:
    """Return the text of a cell's stored outputs."""
    return "".join("".join(out["text"]) for out in cell["outputs"] if "text" in out)


def stored(text: str, pictures: list[bytes]) -> list[dict[str, Any]]:
    """Write a cell's outputs in the notebook's format."""
    lines = text.splitlines(keepends=True)
    outputs: list[dict[str, Any]] = []
    if lines:
        outputs.append({"name": "stdout", "output_type": "stream", "text": lines})
    for picture in pictures:
        data = {"image/png": base64.b64encode(picture).decode()}
        outputs.append({"data": data, "metadata": {}, "output_type": "display_data"})
    return outputs


def main(path: Path) -> None:
    """Run a notebook, and store what it shows."""
    notebook = json.loads(path.read_text(encoding="utf-8"))
    code = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    for number, (cell, result) in enumerate(zip(code, run(notebook["cells"]), strict=True), 1):
        cell["outputs"], cell["execution_count"] = stored(*result), number
    path.write_text(json.dumps(notebook, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


if __name__ == "__main__":
    for name in sys.argv[1:]:
        main(Path(name))
