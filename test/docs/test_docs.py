# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Pages that are generated are as their generators write them; blocks to type do what is said."""

from __future__ import annotations

import contextlib
import inspect
import io
import json
import re
import runpy
from pathlib import Path

import pytest

import delta_dynamics
import stiffness_monitor
from pkm_twin import design, paths, robot_names
from pkm_twin import errors as module
from test.commands.conftest import coarse_pictures  # noqa: F401
from test.support.command import typed_line
from test.support.pages import assert_output, read_section
from tools.pages import errors, notebooks, parameters, public, trend

DOCS = Path(__file__).parents[2] / "docs"


def blocks(page):
    """Language, text and file name of each fenced block; a name stands in the line before it."""
    text = (DOCS / page).read_text(encoding="utf-8")
    for before, language, block in re.findall(r"([^\n]*)\n\n```(\w+)\n(.*?)```", text, re.DOTALL):
        named = re.search(r"`([\w.]+)`:$", before)
        yield language, block, named and named[1]


def run(language, block, twin):
    """What a block prints, in the folder that it is to work in."""
    if language == "bash":
        results = [typed_line(twin, line) for line in block.splitlines()]
        assert all(result.code == 0 for result in results), [result.err for result in results]
        return "".join(result.out for result in results)
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        exec(compile(block, "page", "exec"), {"__name__": "__main__"})
    return printed.getvalue()


@pytest.fixture
def clone(tmp_path, monkeypatch):
    """A folder to work in, as a clone is for what blocks read."""
    for name in ("bags", "examples"):
        (tmp_path / name).symlink_to(DOCS.parent / name)
    monkeypatch.chdir(tmp_path)
    # For what a page has the reader write and import.
    monkeypatch.syspath_prepend(tmp_path)
    return tmp_path


@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    ("page", "made"),
    [
        ("tutorial.md", ("pick.png", "pick_torques.csv", "mine.png")),
        ("new_machine.md", ("my_delta.png", "torques.csv", "converted.yaml")),
    ],
)
def test_a_page_from_its_first_block_to_its_last(page, made, clone, twin):
    printed, ran = "", 0
    for language, block, name in blocks(page):
        if name:
            (clone / name).write_text(block)
        elif language == "text":
            assert_output(block, printed)
        elif language in ("bash", "python"):
            printed = run(language, block, twin)
            ran += 1
    assert ran >= 6
    for path in made:
        assert (clone / path).stat().st_size


@pytest.mark.long
def test_a_printer_from_its_configuration_to_the_next(clone, twin):
    """And the figures of the page are those that are printed."""
    page = (DOCS / "calibration.md").read_text(encoding="utf-8")
    (block,) = (block for language, block, _ in blocks("calibration.md") if "printer" in block)
    printed = run("bash", block, twin)
    for kind, before, after in zip(("height", "distance"), (1.02, 1.06), (2, 3), strict=True):
        (row,) = re.findall(rf"^{kind} +\d+ +([\d.]+) \(.*?\) +([\d.]+)", printed, re.M)
        assert [float(x) for x in row] == pytest.approx([before, after / 1e3], abs=5e-3 * before)
        assert re.search(rf"{kind}s (agree )?to {after} µm[^()]*\({before} mm before\)", page)
    known = r"known\s+to ([\d.]+) mm in 100 mm"
    assert re.findall(known, page) == re.findall(known, printed)
    assert "8 measurements give the position to 0.1 mm" in printed
    assert "delta_radius" in printed


@pytest.mark.long
@pytest.mark.filterwarnings("ignore")
def test_the_blocks_of_the_linkages_page_run(clone, twin):
    printed = [run(language, block, twin) for language, block, _ in blocks("linkages.md")]
    assert len(printed) == 2 and all(printed)
    assert (clone / "ankle_effort.npz").stat().st_size


@pytest.mark.long
def test_the_blocks_of_the_simulators_page_run(tmp_path, twin, monkeypatch):
    monkeypatch.chdir(tmp_path)
    printed = [run(language, block, twin) for language, block, _ in blocks("simulators.md")]
    assert len(printed) == 4 and all(printed)


def test_python_blocks_of_pages(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for page in ("api.md", "design.md", "fit.md", "maps.md", "paths.md", "vibration.md"):
        space = {}
        for language, block, _ in blocks(page):
            if language == "python":
                exec(compile(block, page, "exec"), space)


@pytest.mark.long
@pytest.mark.timeout(900)
def test_commands_of_the_design_page(tmp_path, twin, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for language, block, _ in blocks("design.md"):
        if language == "bash":
            run(language, block, twin)
    assert {path.name for path in tmp_path.iterdir()} >= {"better.yaml", "better.png", "box.nc"}


@pytest.mark.parametrize("name", ["design_a_delta", "rail_delta"])
def test_the_example_runs(name):
    runpy.run_path(str(DOCS.parent / f"examples/{name}.py"), run_name="__main__")


@pytest.mark.parametrize(
    "name",
    [
        "path_torques",
        "stiffness_map",
        *(pytest.param(one, marks=pytest.mark.long) for one in ("design", "fit", "bag_in_pandas")),
    ],
)
def test_a_notebook_shows_what_it_stores(name, clone):
    """Else `make pages` stores it."""
    cells = json.loads((DOCS.parent / f"examples/{name}.ipynb").read_text(encoding="utf-8"))["cells"]
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    for cell, (text, pictures) in zip(code, notebooks.run(cells), strict=True):
        assert_output(notebooks.text_of(cell), text)
        assert len(pictures) == sum("data" in out for out in cell["outputs"])


def test_the_parameters_page_is_that_of_the_schemas():
    """Else `make pages` writes it anew."""
    assert (DOCS / "parameters.md").read_text(encoding="utf-8") == parameters.page()


def test_the_errors_page_has_every_error_and_reason():
    """Else `make pages` writes it."""
    assert read_section("errors", DOCS / "errors.md") == errors.section()
    own = {kind for kind in vars(module).values() if inspect.isclass(kind)}
    assert {k for k in own if issubclass(k, module.PkmTwinError)} - {module.PkmTwinError} <= set(errors.ERRORS)
    assert set(errors.REASONS) == errors.reasons()


@pytest.mark.long
def test_the_output_of_the_trend_page_is_todays(tmp_path):
    """Else `make pages` writes it and draws its picture."""
    page = (DOCS / "recordings.md").read_text(encoding="utf-8")
    assert trend.rewrite_page(page, tmp_path / "trend.png") == page
    assert (tmp_path / "trend.png").stat().st_size


@pytest.mark.parametrize("package", [delta_dynamics, stiffness_monitor, paths, design])
def test_the_python_page_has_each_public_name(package):
    page = (DOCS / "api.md").read_text(encoding="utf-8")
    listed = re.search(rf"::: {package.__name__}\n.*?members: \[(.*?)\]", page, re.DOTALL)[1]
    assert sorted(re.split(r",\s+", listed)) == sorted(package.__all__)


def test_public_names_change_only_with_an_announcement():
    found, known = (
        {line.rpartition(": ")[0]: set(line.split(": ")[-1].split()) for line in text.splitlines()}
        for text in (public.names(), (DOCS / "public_names.txt").read_text(encoding="utf-8"))
    )
    changes = [
        f"{group}: {word} {sorted(names)}"
        for one, other, word in ((known, found, "without"), (found, known, "with"))
        for group in one
        if (names := one[group] - other.get(group, set()))
    ]
    assert not changes, (
        f"{'; '.join(changes)}. A replaced name works until the next major version "
        "(docs/stability.md). Write a line in CHANGELOG.md under Added or Changed, with reason and "
        "replacement, and run `make pages`."
    )


def test_every_robot_has_its_picture():
    """Else `make pictures` draws it."""
    for name in robot_names():
        assert (DOCS / "gallery" / f"robot_{name}.png").stat().st_size, name
        assert f"robot_{name}.png" in (DOCS / "index.md").read_text(encoding="utf-8")


def test_the_animation_is_small():
    """Else `make animation` draws it."""
    assert 50e3 < (DOCS / "gallery" / "load.gif").stat().st_size < 1.5e6
