# SPDX-License-Identifier: Apache-2.0
"""The command ``pkm-twin``. Exit codes: 0 good, 1 rejected, 2 usage, 3 recovered with loss."""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, NoReturn

import numpy as np
import typer
from rich.table import Table
from rich.text import Text

from pkm_twin.apps import export, maps
from pkm_twin.apps.calibrate import calibrate_command
from pkm_twin.apps.certify_command import certify
from pkm_twin.apps.check_command import check
from pkm_twin.apps.compliance import compliance
from pkm_twin.apps.design import design_command
from pkm_twin.apps.drive_friction import drive_friction_command
from pkm_twin.apps.excite import excite
from pkm_twin.apps.feed import feed
from pkm_twin.apps.fit import fit
from pkm_twin.apps.groups import Tasks, greet
from pkm_twin.apps.guard_check import guard_check
from pkm_twin.apps.joint_loads import loads
from pkm_twin.apps.options import (
    REFUSED,
    SALVAGED,
    BagPath,
    BagTopics,
    BeyondLimits,
    Json,
    LoadTimes,
    Payload,
    Platform,
    RobotName,
    load_of,
)
from pkm_twin.apps.path import path_command
from pkm_twin.apps.printer import export_printer, printer_command
from pkm_twin.apps.record_kit import record_kit
from pkm_twin.apps.size import size
from pkm_twin.apps.tables import tables
from pkm_twin.apps.trend import trend
from pkm_twin.apps.vibration import frf, lobes
from pkm_twin.apps.view.command import view
from pkm_twin.console import (
    flush_output,
    print_json,
    progress,
    refuse_existing,
    silence_output,
    system_error,
    table_console,
    tell,
    writing,
)
from pkm_twin.errors import ParameterError, PkmTwinError, plain_warnings
from pkm_twin.files import STANDARD, open_standard_streams
from pkm_twin.options import Commands, OptionalFloat, OptionalPath, file_name
from pkm_twin.ros.signals import INTERRUPTED, first_signal, ignore_signals

app = Commands(
    cls=Tasks,
    invoke_without_command=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


def _version(asked: bool) -> None:
    if asked:
        from importlib.metadata import PackageNotFoundError, version

        try:
            typer.echo(f"pkm-twin {version('pkm_twin')}")
        except PackageNotFoundError:
            typer.echo("pkm-twin, version unknown (not installed, runs from its sources)")
        raise typer.Exit


@app.callback()
def _application(
    context: typer.Context,
    _asked: Annotated[
        bool,
        typer.Option("--version", help="print the version", callback=_version, is_eager=True),
    ] = False,
) -> None:
    """Compute torques and stiffness of parallel robots, and compare recordings with the model.

    Start with `pkm-twin robots`, then `pkm-twin info delta_cu`; or check a recording with
    `pkm-twin check BAG`. SI units, world z up. Only play, monitor-torques and view --live need ROS.

    Exit codes: 0 good, 1 bad or invalid, 2 wrong usage, 3 recovered with loss. An error is one line
    on stderr. Results go to stdout, with --json as JSON only.
    """
    greet(context)


@app.command()
def play(
    bag: BagPath,
    rate: Annotated[float, typer.Option(help="speed factor; 1 is the recorded speed")] = 1.0,
    loop: Annotated[bool, typer.Option("--loop", help="restart at the end")] = False,
    clock: Annotated[
        OptionalFloat,
        typer.Option(help="publish /clock at this many Hz, for nodes with use_sim_time"),
    ] = None,
    wait: Annotated[
        float, typer.Option(help="longest wait (s) for a subscriber on every topic")
    ] = 3.0,
    topic: Annotated[list[str], typer.Option(help="play only these topics")] = [],  # noqa: B006
    remap: Annotated[
        list[str], typer.Option(help="FROM:=TO, play a topic under another name")
    ] = [],  # noqa: B006  typer copies it
    quiet: Annotated[bool, typer.Option("--quiet", help="no progress bar")] = False,
) -> None:
    """Replay a bag onto ROS topics.

    Works like `ros2 bag play`, on machines that do not have it. The whole bag is checked before
    anything is published. Messages are published in the order of their log time, byte for byte as
    recorded.

    Time stamps in a bag are old, so the nodes reject them unless you use simulated time: set
    use_sim_time on the nodes and give this command --clock 200.
    """
    from pkm_twin.ros.player import play as play_bag

    pairs = dict(_pair(text) for text in remap)
    result = play_bag(
        bag,
        rate=rate,
        loop=loop,
        clock=clock,
        wait_for_subscribers=wait,
        topics=topic or None,
        remap=pairs,
        progress=not quiet,
    )
    if result.interrupted:
        ignore_signals()


@app.command()
def robots() -> None:
    """List the robots that ship with pkm_twin."""
    from pkm_twin import load, robot_names
    from pkm_twin.apps.describe import summary

    for name in robot_names():
        typer.echo(f"{name:12} {summary(load(name))}")


@app.command()
def info(
    robot: RobotName,
    platform: Platform = None,
    as_json: Json = False,
    picture: Annotated[
        OptionalPath,
        typer.Option(
            help="draw the robot at home into this file, .png or .svg", callback=file_name
        ),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace the picture")] = False,
) -> None:
    """Show a robot's parameters, with units.

    Prints dimensions, masses, limits, home pose and mobility. For an overconstrained mechanism it
    also lists the joint reactions that rigid-body equations do not determine.
    """
    from pkm_twin import load
    from pkm_twin.apps.describe import describe, lines

    if picture is not None:
        refuse_existing(picture, overwrite)
    loaded = load(robot, platform=platform)
    data = describe(loaded)
    if picture is not None:
        from pkm_twin.apps import drawing

        drawing.picture(loaded, picture)
    if as_json:
        # JSON has no infinity: a free axis is null.
        print_json(_finite(data))
        return
    table = Table(show_header=False)
    for what, value in lines(data):
        table.add_row(what, Text(value))
    table_console().print(table)


@app.command()
def urdf(
    robot: RobotName,
    platform: Platform = None,
    hardware_plugin: Annotated[
        str, typer.Option(help="hardware plugin of ros2_control", metavar="NAME")
    ] = "mock_components/GenericSystem",
    prefix: Annotated[
        str, typer.Option(help="prefix for the names of all links and joints", metavar="TEXT")
    ] = "",
    no_ros2_control: Annotated[
        bool, typer.Option("--no-ros2-control", help="write no ros2_control element")
    ] = False,
) -> None:
    """Print a robot as a URDF, with its loops as constraints.

    The URDF is a tree with all joints, actuated and passive, and a <constraint> element for each
    loop that was cut. Parsers that know only trees ignore these elements. The base is the link
    base_link, the platform the link platform. The same robot always gives the same bytes.
    """
    from pkm_twin import load
    from pkm_twin.robot.robot_urdf import robot_urdf

    if re.search(r"[^\w./-]", prefix, re.ASCII):
        raise ParameterError("--prefix", prefix, "letters, digits and . / _ -")
    if not hardware_plugin.strip():
        raise ParameterError("--hardware-plugin", hardware_plugin, "a plugin, or --no-ros2-control")
    loaded = load(robot, platform=platform)
    typer.echo(robot_urdf(loaded, "" if no_ros2_control else hardware_plugin, prefix), nl=False)


@app.command()
def convert(robot: RobotName, platform: Platform = None) -> None:
    """Convert a robot, or a URDF with its loops, to a YAML.

    Prints a commented YAML of bodies, joints and rods. It is a complete robot: edit it, and use its
    path in place of a robot's name.
    """
    from pkm_twin import load
    from pkm_twin.machine.machine_yaml import describe_machine_yaml
    from pkm_twin.robot.catalogue import TREES
    from pkm_twin.robot.robot_urdf import robot_description
    from pkm_twin.robot.urdf_read import read_urdf

    path = Path(robot)
    if path.suffix in TREES:
        data = read_urdf(path, platform=platform)
    else:
        data = robot_description(load(robot, platform=platform))
    typer.echo(describe_machine_yaml(data), nl=False)


@app.command()
@tables
def torques(
    robot: RobotName,
    motion: Annotated[Path, typer.Argument(help="a bag, or a CSV with a header row")],
    out: Annotated[
        Path,
        typer.Option(
            help="table to write, .csv, .parquet or .mat; the picture has the same name with .png",
            callback=file_name,
        ),
    ] = Path("torques.csv"),
    picture: Annotated[bool, typer.Option(help="plot efforts and terms as a PNG")] = True,
    topic: BagTopics = [],  # noqa: B006  typer copies it
    payload: Payload = None,
    load_times: LoadTimes = None,
    beyond_limits: BeyondLimits = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="replace the table and the picture")
    ] = False,
) -> None:
    """Compute torques, their terms and joint reactions.

    CSV columns: time (s) and JOINT.position (rad or m) for every actuated joint. Optional:
    JOINT.velocity and JOINT.acceleration, which are otherwise differentiated from the positions,
    and the wrench on the platform, fx fy fz mx my mz (N, N m, base axes). `pkm-twin info` lists the
    joint names.

    The table has one row per sample: each joint's effort (N m or N), the terms that sum to it
    (JOINT.effort_gravity, _inertia, _velocity, _payload, _friction, _external), the measured effort
    of a bag, and force and moment in every joint. A reaction that rigid-body equations do not
    determine is empty. With --beyond-limits, the column beyond_limits is 1 where a joint is outside
    its limits.
    """
    from pkm_twin.apps.limits import beyond_limits as find_beyond
    from pkm_twin.apps.limits import refuse_beyond
    from pkm_twin.apps.torques import check_target, motion_of, table, write_table
    from pkm_twin.bags.storage import is_bag
    from pkm_twin.maps import plots

    check_target(out)
    drawing, piped = out.with_suffix(".png"), str(out) == STANDARD
    picture = picture and not piped
    for target in (out, drawing) if picture else (out,):
        refuse_existing(target, overwrite, motion)
    carried = load_of(payload, load_times)
    if topic and not is_bag(motion):
        raise typer.BadParameter(f"--topic is for bags; {motion} is read as CSV")
    data = motion_of(motion, robot, topic, carried)
    _, found = find_beyond(data.robot, data.q, data.qd)
    if not beyond_limits:
        refuse_beyond(found)
    with progress("torques", len(data.time)) as update:
        columns = table(data, update)
    with writing(out):
        write_table(columns, out)
        typer.echo(f"{out}: {len(data.time)} rows, {len(columns)} columns", err=piped)
        if picture:
            typer.echo(f"{plots.save(plots.torques(data, columns), drawing)}")
    for note in (*data.notes, *(f"beyond limits: {item}" for item in found)):
        typer.echo(note, err=piped)


# A negative number is no option.
app.command(context_settings={"ignore_unknown_options": True})(compliance)


@app.command()
def recover(
    bag: BagPath,
    out: Annotated[Path, typer.Argument(help="the new bag", callback=file_name)],
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace the target")] = False,
    as_json: Json = False,
) -> None:
    """Save the intact messages of a damaged bag.

    Copies every intact message of a damaged or truncated bag into a new bag. The old bag does not
    change.

    Exit code 0: nothing was lost. 3: some messages were lost. 1: nothing could be saved.
    """
    from dataclasses import asdict

    from pkm_twin.bags.recover import recover as recover_bag

    result = recover_bag(bag, out, overwrite=overwrite)
    if as_json:
        print_json({**asdict(result), "lossless": result.lossless})
    else:
        lost = (
            "nothing lost"
            if result.lossless
            else f"{result.bytes_lost} bytes lost: {result.reason}"
        )
        typer.echo(f"{out}: {result.messages} messages saved, {lost}")
    if not result.lossless:
        raise typer.Exit(SALVAGED)


app.command()(certify)
app.add_typer(maps.app, name="map")
app.add_typer(export.app, name="export")
app.command("calibrate")(calibrate_command)
app.command("printer")(printer_command)
export.app.command("printer")(export_printer)
app.command("design")(design_command)
app.command("drive-friction")(drive_friction_command)
app.command("path")(tables(path_command))
app.command()(tables(feed))
app.command()(tables(size))
app.command()(tables(loads))
app.command()(frf)
app.command()(lobes)
app.command("monitor-torques")(guard_check)
app.command("guard-check", hidden=True, help="The older name of `monitor-torques`.")(guard_check)
app.command()(tables(check))
app.command()(trend)
app.command()(view)
app.command()(tables(fit))
app.command()(excite)
app.command()(record_kit)


def _finite(data: Any) -> Any:
    if isinstance(data, dict):
        return {key: _finite(value) for key, value in data.items()}
    if isinstance(data, list):
        return [_finite(value) for value in data]
    return None if isinstance(data, float) and not np.isfinite(data) else data


def _pair(text: str) -> tuple[str, str]:
    source, sign, target = text.partition(":=")
    if not sign or not source or not target:
        raise typer.BadParameter(f"{text!r} is not of the form FROM:=TO")
    return source, target


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point: errors are one line on stderr and exit code 1, Ctrl-C is code 130."""
    open_standard_streams()
    try:
        with first_signal(lambda: SystemExit(INTERRUPTED)), plain_warnings():
            app(arguments, prog_name="pkm-twin")
    except SystemExit:
        failed = flush_output()
        if failed and not isinstance(failed, BrokenPipeError):
            _end(f"cannot write the output: {system_error(failed)}")
        raise
    except BrokenPipeError:
        # Whoever read the output has seen enough.
        silence_output()
        sys.exit(REFUSED)
    except PkmTwinError as error:
        _end(str(error))
    except OSError as error:
        flush_output()
        # Every file that a command opens has a name, the output has none.
        _end(f"{'' if error.filename else 'cannot write the output: '}{system_error(error)}")


def _end(text: str) -> NoReturn:
    tell(text)
    sys.exit(REFUSED)


if __name__ == "__main__":
    main()
