# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""What commands write: whole or not at all, over nothing but files, whatever names are about."""

import os
import shutil
import stat
import subprocess
import sys
import threading

import pytest

from pkm_twin.bags.reader import BagWriter, open_bag
from pkm_twin.errors import BagError
from pkm_twin.files import replace_file, write_atomically
from test.bags.test_recordings import FOLDER
from test.commands.test_fit_compliance import SOFT, THIRD, table
from test.support.command import forked
from test.support.robots import load, partly_long

REPOSITORY = FOLDER.parent
EXCITE = ("excite", "five_bar", "--trials", 10, "--duration", 2)
ODD = "a$\\x$ \udcff\nb"
"""A formula that is none, a byte that is no text, and a new line."""


@pytest.fixture
def deflections(tmp_path):
    return table(tmp_path / "deflections.csv", rows=THIRD)


def commands(deflections, target):
    """Every command that writes a file, by what its name ends in."""
    stem = target.with_suffix("")
    return {
        ".html": ("fit", "upr_rpu", deflections, "--what", "compliance", "--out", f"{stem}.yaml"),
        ".yaml": ("fit", "upr_rpu", deflections, "--what", "compliance", "--out", f"{stem}.yaml"),
        ".yml": ("calibrate", "upr_rpu", deflections, "--out", f"{stem}.yml"),
        ".mcap": (*EXCITE, "--out", f"{stem}.mcap"),
        ".csv": (*EXCITE, "--out", f"{stem}.mcap"),
        ".png": ("info", "five_bar", "--picture", f"{stem}.png"),
        ".bag": ("recover", SOFT, f"{stem}.bag"),
        ".nc": ("map", "five_bar", "workspace", "--points", 1000, "--out", f"{stem}.nc"),
    }


@pytest.mark.parametrize("ending", [".html", ".yaml", ".yml", ".mcap", ".csv", ".png", ".bag", ".nc"])
@pytest.mark.parametrize("kind", ["a FIFO", "a folder", "a character device"])
def test_only_files_are_replaced(twin, tmp_path, deflections, ending, kind):
    if ending == ".nc":
        pytest.importorskip("h5netcdf")
    target = tmp_path / f"target{ending}"
    {
        "a FIFO": os.mkfifo,
        "a folder": os.mkdir,
        "a character device": lambda path: path.symlink_to("/dev/null"),
    }[kind](target)
    before = os.lstat(target).st_ino
    error = twin.refused(*commands(deflections, target)[ending], "--overwrite")
    assert str(target) in error and "regular file" in error
    assert os.lstat(target).st_ino == before
    assert stat.S_ISCHR(os.stat("/dev/null").st_mode)
    assert {p.name for p in tmp_path.iterdir()} == {target.name, deflections.name}


@pytest.mark.parametrize("name", ["", ".", "/", "..", "folder/.."])
def test_a_folder_or_nothing_is_no_files_name(twin, tmp_path, monkeypatch, deflections, name):
    """Every command that writes refuses it before it works, and before it opens what it reads."""
    monkeypatch.chdir(tmp_path)
    tried = 0
    for line in commands(deflections, tmp_path / "target").values():
        where = next(k for k, word in enumerate(line) if str(word).startswith(f"{tmp_path}/target"))
        error = twin.refused(*line[:where], name, *line[where + 1 :], "--overwrite")
        option = line[where - 1] if str(line[where - 1]).startswith("--") else "OUT"
        assert error.startswith(f"pkm-twin: {option}: ")
        tried += 1
    for line in (("torques", "five_bar", "none.csv", "--out"), ("map", "show", "none.nc", "--out")):
        assert twin(*line, name).one_line_error().startswith("pkm-twin: --out: ")
    assert tried == 8
    assert [p.name for p in tmp_path.iterdir()] == [deflections.name]


def test_a_folder_that_is_not_there_is_told_before_the_work(twin, tmp_path, monkeypatch):
    """Before the recording is read, which is not there either."""
    monkeypatch.chdir(tmp_path)
    for line in (
        ("torques", "five_bar", "none.csv", "--out", "none/a.csv"),
        ("fit", "five_bar", "none.csv", "--out", "none/a.yaml"),
        ("calibrate", "five_bar", "none.csv", "--out", "none/a.yaml"),
        ("excite", "five_bar", "--out", "none/a.mcap"),
        ("info", "five_bar", "--picture", "none/a.png"),
    ):
        error = twin.refused(*line)
        assert line[-1] in error and "no folder none" in error
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("line", "text"),
    [
        (("fit", "five_bar", "none.csv"), "none.csv: no such file"),
        (("fit", "five_bar", "out.yaml", "--what", "nothing"), "--what: 'nothing'"),
        (("fit", "nobody", "out.yaml"), "unknown robot 'nobody'"),
        (("fit", "five_bar", "out.yaml", "--payload", "1,2"), "--payload: '1,2'"),
        (("calibrate", "delta", "none.csv"), "none.csv: no such file"),
        (("calibrate", "delta", "out.yaml", "--measure", "nothing"), "--measure: 'nothing'"),
        (("calibrate", "delta", "out.yaml", "--noise", "height=1e-4"), "--noise: 'height'"),
        (("calibrate", "delta"), "poses: missing"),
        (("convert", "nofile"), "SOURCE: 'nofile'"),
    ],
)
def test_a_wrong_input_is_told_before_a_target_that_is_there(twin, tmp_path, monkeypatch, line, text):
    monkeypatch.chdir(tmp_path)
    names = ("out.yaml", "fitted.yaml", "calibrated.yaml")
    for name in names:
        (tmp_path / name).write_text("kept")
    assert text in twin(*line).one_line_error()
    if line[0] in ("fit", "calibrate"):
        twin(*line, "--out", "out.yaml")
    assert {(tmp_path / name).read_text() for name in names} == {"kept"}


def test_a_name_as_long_as_the_file_system_takes(twin, tmp_path, deflections):
    longest = "n" * 250
    for arguments in (
        ("fit", "upr_rpu", deflections, "--what", "compliance", "--out", f"{longest}.yaml"),
        ("recover", SOFT, f"{longest}.mcap"),
        (*EXCITE, "--out", f"m{longest[1:]}.mcap"),
    ):
        done = forked(tmp_path, *arguments)
        assert done.code == 0, done.err
    assert {p.suffix for p in tmp_path.glob("?nnn*")} == {".yaml", ".html", ".mcap", ".csv"}
    assert not list(tmp_path.glob(".*"))


def test_two_writers_of_one_target_leave_one_of_two_whole_files(tmp_path):
    target = tmp_path / "fitted.yaml"
    texts = [bytes([letter]) * 300_000 for letter in b"ab"]

    def write(text):
        for _ in range(50):
            replace_file(target, text)

    writers = [threading.Thread(target=write, args=(text,)) for text in texts]
    for writer in writers:
        writer.start()
    while any(writer.is_alive() for writer in writers):
        if target.exists():
            assert target.read_bytes() in texts
    for writer in writers:
        writer.join()
    assert [p.name for p in tmp_path.iterdir()] == [target.name]


def test_two_recorders_of_one_bag_leave_one_of_two_whole_bags(tmp_path):
    target = tmp_path / "bag.mcap"
    message = {"data": True}
    bags = []
    for _ in range(2):
        bag = BagWriter(target, overwrite=True)
        bag.add_topic("/contact", "std_msgs/msg/Bool", definition="bool data")
        bags.append(bag)
    for k in range(2000):
        bags[k % 2].write("/contact", message, k)
    for bag in bags:
        bag.close()
    assert len(list(open_bag(target).messages())) == 1000
    with pytest.raises(BagError, match="exists"):
        BagWriter(target)


def test_a_target_that_fails_stays_as_it_was(tmp_path):
    target = tmp_path / "a.yaml"
    target.write_text("before")
    with pytest.raises(OSError, match="No space"), write_atomically(target) as hidden:
        hidden.write_text("half")
        raise OSError(28, "No space left on device", str(hidden))
    assert target.read_text() == "before"
    assert [p.name for p in tmp_path.iterdir()] == [target.name]
    # Under its own name, which alone is known.
    with pytest.raises(OSError, match="No space") as caught, write_atomically(target) as hidden:
        raise OSError(28, "No space left on device", str(hidden))
    assert caught.value.filename == str(target)


def test_a_full_disk_is_the_targets(tmp_path, deflections):
    """Not the bag's that is read, and no half of a file stays."""
    done = forked(tmp_path, "recover", SOFT, "saved.mcap", limit=10_000)
    assert done.code == 1
    assert "saved.mcap: cannot be written: File too large" in done.one_line_error()
    done = forked(tmp_path, "fit", "upr_rpu", deflections, "--what", "compliance", limit=10_000)
    assert done.code == 1
    assert "fitted.html: File too large" in done.one_line_error()
    assert {p.name for p in tmp_path.iterdir()} == {"fitted.yaml", deflections.name}


def test_what_is_read_is_not_replaced(twin, tmp_path, deflections):
    for line, name in (
        (("calibrate", "upr_rpu"), "a.yaml"),
        (("torques", "delta"), "b.csv"),
    ):
        same, link = tmp_path / name, tmp_path / f"link_{name}"
        shutil.copy(deflections, same)
        link.symlink_to(same)
        for out in (same, link):
            assert "the same file" in twin.refused(*line, same, "--out", out, "--overwrite")
            assert same.read_bytes() == deflections.read_bytes()


def test_names_of_anything_in_titles_and_comments(tmp_path, deflections):
    """A formula in a title, a new line in a YAML's comment, a byte that no page can hold."""
    pytest.importorskip("h5netcdf")
    robot = tmp_path / f"{ODD}.yaml"
    shutil.copy(REPOSITORY / "config" / "upr_rpu.yaml", robot)
    recording = tmp_path / f"{ODD}.csv"
    shutil.copy(deflections, recording)
    five = tmp_path / f"five {ODD}.yaml"
    shutil.copy(REPOSITORY / "config" / "five_bar.yaml", five)
    for arguments in (
        ("fit", robot.name, recording.name, "--what", "compliance"),
        ("info", five.name, "--picture", f"{ODD}.png"),
        (*EXCITE, "--out", "motion.mcap"),
        ("torques", five.name, "motion.csv", "--out", f"torques {ODD}.csv"),
        (
            "map",
            five.name,
            "workspace",
            "--points",
            1000,
            "--out",
            f"{ODD}.nc",
            "--html",
            "--overwrite",
        ),
        ("urdf", robot.name),
        ("info", robot.name, "--json"),
    ):
        done = forked(tmp_path, *arguments)
        assert (done.code, done.err) == (0, ""), (arguments, done.err)
    assert load(str(tmp_path / "fitted.yaml")).mechanism == "upr_rpu"


BOTH = """
from pkm_twin.apps import cli
codes = []
for name in ("five_bar", "none"):
    try:
        cli.main(["info", name])
    except SystemExit as end:
        codes.append(int(end.code or 0))
raise SystemExit(10 if codes == [0, 1] else 1)
"""
"""Two commands, of which the second one fails."""


@pytest.mark.parametrize("closed", partly_long([">&-", ">&- 2>&-", "<&- >&- 2>&-"], ">&-", "<&- >&- 2>&-"))
def test_closed_outputs_lead_nowhere(tmp_path, closed):
    """Else the first file that is opened gets what is printed."""
    (tmp_path / "both.py").write_text(BOTH)
    done = subprocess.run(
        f"{sys.executable} both.py {closed}",
        shell=True,
        cwd=tmp_path,
        capture_output=True,
        text=True,
        stdin=subprocess.DEVNULL,
        env=os.environ | {"PYTHONPATH": str(REPOSITORY)},
    )
    assert done.returncode == 10
    assert done.stdout == "" and "Traceback" not in done.stderr


PATH = "path five_bar --circle 0.02 --no-picture --out"
FULL = [
    f"{PATH} out.mcap",
    f"{PATH} out.csv",
    "export c five_bar --out c",
    "export ros2-control five_bar --out control",
]


@pytest.mark.parametrize("line", partly_long(FULL, FULL[0], FULL[2]))
def test_a_full_disk_leaves_no_part_under_a_final_name(line, tmp_path):
    """Neither of a file nor of a folder's files: what is there has all of it."""
    program = (
        "import resource, signal, sys\nfrom pkm_twin.apps import cli\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (6000, 6000))\n"
        "cli.main(sys.argv[1:])\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, *line.split()],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": str(REPOSITORY)},
        check=False,
    )
    assert done.returncode == 1, done.stderr
    assert done.stderr.strip().splitlines()[-1].startswith("pkm-twin: ")
    assert "Traceback" not in done.stderr and ".tmp" not in done.stderr
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]
