# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""A class of settings as a command: its options, its targets, its report, its exit code."""

import json
from dataclasses import dataclass
from pathlib import Path

import click
import pytest

from pkm_twin.apps.frame import Group, command
from pkm_twin.apps.options import OutputOption, PictureOptions, RobotArgument
from pkm_twin.errors import ParameterError
from pkm_twin.report import Column, Fact, Report, Table, Verdict, make_judged_fact, plots
from pkm_twin.report.terminal import WIDTH, format_report, table_lines
from pkm_twin.settings import setting


@dataclass(frozen=True, kw_only=True)
class Weigh(RobotArgument, OutputOption, PictureOptions):
    """Weigh a robot."""

    times: tuple[int, ...] = setting((), "how often", argument=True)
    scale: float = setting(2.0, "of the balance", low=1.0, high=5.0, older=("--balance",))
    at: tuple[float, ...] | None = setting(None, "where", count=2)
    how: str = setting("fast", "how", choices=("fast", "slow"))
    on: str | None = setting(None, "what it stands on")
    bad: bool = setting(False, "what it finds is bad")
    no_lid: bool = setting(False, "without its lid")
    out: Path | None = setting(None, "table", writes=True, endings=(".csv",))


SEEN = []


def weigh(given: Weigh) -> Report:
    SEEN.append(given)
    if given.on is not None:
        raise ParameterError(f"on {given.on}", given.on, "a table")
    if given.robot == "feather":
        raise ParameterError("scale", given.scale, "one for a feather")
    columns = [Column("mass", "kg"), Column("length", "m", "long", 1e3, "mm")]
    return Report(
        "2 kg",
        [Fact("mass", 2.0, "kg", "mass"), Fact("lost", float("nan"))],
        [Table("parts", columns, {"arm": [1.5, 0.25], "rod": [0.5, None]})],
        {"": lambda: plots.make_subplots(1, 1)[0]},
        verdict=Verdict.BAD if given.bad else None,
    )


@pytest.fixture
def run(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    made = command("Robots")(weigh)

    def call(*words):
        SEEN.clear()
        code = made.main(list(words), prog_name="weigh", standalone_mode=False)
        return code or 0, capsys.readouterr().out

    return call


def test_words_become_values(run):
    run("cart", "-3", "--balance", "3", "--at", "-1,2e-3", "--how", "slow", "4")
    (given,) = SEEN
    assert given == Weigh(robot="cart", times=(-3, 4), scale=3.0, at=(-1.0, 0.002), how="slow")
    run("cart", "--out", "-1.csv", "--no-picture")
    assert SEEN[0].out == Path("-1.csv")
    for wrong in (("--scale", "9"), ("--scale", "nan"), ("--at", "1"), ("--how", "well"), ("-4", "9" * 400)):
        with pytest.raises(Exception, match=wrong[1]):
            run("cart", *wrong)
        assert not SEEN


def test_words_that_cannot_be_read_are_wrong_usage_and_a_machines_bounds_are_not(run):
    with pytest.raises(click.UsageError, match=r"^--on air: 'air'; expected a table"):
        run("cart", "--on", "air")
    with pytest.raises(ParameterError, match=r"^scale: 3"):
        run("feather", "--scale", "3")


def test_rounding_is_shown_as_zero_in_a_column_of_one_unit_alone():
    table = Table("", [Column("a", "N m"), Column("b")], {"x": [2.0, 2.0], "y": [1e-12, 1e-12]})
    assert table.cells[1:] == [("x", "2", "2"), ("y", "0", "1e-12")]


def test_json_has_the_facts_with_units_and_the_terminal_the_answer_first(run):
    code, out = run("cart", "--json", "--bad")
    assert code == 1
    assert json.loads(out) == {
        "mass": 2.0,
        "lost": None,
        "verdict": "bad",
        "picture": None,
        "pictures": [],
        "parts": {"arm": {"mass": 1.5, "length": 0.25}, "rod": {"mass": 0.5, "length": None}},
        "units": {"mass": "kg", "parts.mass": "kg", "parts.length": "m"},
    }
    code, out = run("cart")
    lines = out.splitlines()
    assert (code, lines[:2]) == (0, ["2 kg", "mass: 2 kg"])
    assert [line.split() for line in lines[3:]] == [
        ["mass", "(kg)", "long", "(mm)"],
        ["arm", "1.5", "250"],
        ["rod", "0.5", "-"],
    ]


def test_a_wide_table_may_have_a_column_that_is_blank():
    columns = [Column("sigma"), Column("text", text="what varies"), Column("", text=" ")]
    words = " ".join(["word"] * 30)
    lines = table_lines(Table("parts", columns, {"arm": [1e-5, words, ""]}))
    assert " ".join(lines[1:]).split().count("word") == 30
    assert max(map(len, "\n".join(lines).splitlines())) <= WIDTH


@pytest.mark.parametrize(
    ("words", "drawn"),
    [
        ((), None),
        (("--picture",), "weigh_cart.png"),
        (("--picture", "a.svg"), "a.svg"),
        (("--out", "t.csv"), "t.png"),
        (("--out", "t.csv", "--no-picture"), None),
        (("--out", "t.csv", "--picture=b.pdf"), "b.pdf"),
    ],
)
def test_a_picture_has_its_name_from_the_line_or_the_table(run, tmp_path, words, drawn):
    code, out = run("cart", *words, "--json")
    assert (code, json.loads(out)["picture"]) == (0, drawn)
    assert [path.name for path in tmp_path.iterdir()] == ([drawn] if drawn else [])


def test_targets_are_checked_before_the_work(run, tmp_path):
    (tmp_path / "t.png").write_text("kept")
    for words in (("--out", "t.csv"), ("--out", "t.txt"), ("--picture=t.gif",)):
        with pytest.raises(Exception, match=r"t\.(png|txt|gif)"):
            run("cart", *words)
        assert not SEEN and (tmp_path / "t.png").read_text() == "kept"
    run("cart", "--out", "t.csv", "--overwrite")
    assert SEEN and (tmp_path / "t.png").read_bytes().startswith(b"\x89PNG")


def test_a_table_on_stdout_has_its_report_on_stderr(capfd):
    made = command("Robots")(weigh)
    made.main(["cart", "--out", "-", "--json"], prog_name="weigh", standalone_mode=False)
    out, err = capfd.readouterr()
    assert (out, json.loads(err)["mass"]) == ("", 2.0)


def test_another_command_of_a_group_is_wrong_usage():
    both = {"weigh": command()(weigh), "tare": command()(weigh)}
    made = Group("scales", "Scales.", both)
    with pytest.raises(click.UsageError, match="'weight'; did you mean 'weigh'"):
        made.main(["weight"], standalone_mode=False)


def test_judged_facts_are_items():
    report = Report(facts=[make_judged_fact("rate", "900 Hz", "1 kHz", False), make_judged_fact("gaps", "?", "", None)])
    assert [item["verdict"] for item in report.data["items"]] == ["bad", "unknown"]


@pytest.mark.parametrize(("word", "without"), [("--lid", False), ("--no-lid", True)])
def test_what_is_so_without_a_word_may_be_said(run, word, without):
    run("cart", word)
    assert SEEN[-1].no_lid is without


def test_a_picture_goes_to_stdout_and_the_report_to_stderr(capsysbinary):
    made = command("Robots")(weigh)
    made.main(["cart", "--picture", "-", "--json"], prog_name="weigh", standalone_mode=False)
    out, err = capsysbinary.readouterr()
    assert out[:4] == b"\x89PNG"
    assert json.loads(err)["picture"] == "-"
    with pytest.raises(click.UsageError):
        made.main(["cart", "--picture", "-", "--out", "-"], standalone_mode=False)


def test_a_wide_table_fits_the_terminal_and_loses_no_word():
    columns = [Column("", "N m", f"greatest effort of joint {k}") for k in range(6)]
    rows = {f"joint_{k}": [*map(float, range(6)), "words of a cell " * 6] for k in range(3)}
    few = Table("", columns[:2], {"a": [1.0] * 2})
    wide = Table("", [*columns, Column("", "", "what it is")], rows)
    for table in (few, wide):
        lines = format_report(Report("", tables=[table])).splitlines()
        assert max(map(len, lines)) <= WIDTH
        assert table is wide or len(lines) == 2
        words = " ".join(cell for row in table.cells for cell in row).split()
        assert sorted(" ".join(lines).split()) == sorted(words)
