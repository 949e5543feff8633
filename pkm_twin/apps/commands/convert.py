# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""``pkm-twin convert``: a robot, or a printer's configuration, as a robot file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pkm_twin.apps.frame import command
from pkm_twin.apps.options import ROBOT_HELP, CutOutOptions, OutputOption
from pkm_twin.console import reject_existing
from pkm_twin.errors import FileError, UnknownNameError, one_line
from pkm_twin.files import open_regular, replace_file
from pkm_twin.mechanisms.catalogue import TREE_SUFFIXES, load, robot_names
from pkm_twin.report import Fact, Report
from pkm_twin.robot.printers import Firmware, read_printer
from pkm_twin.settings import setting


@dataclass(frozen=True, kw_only=True)
class Convert(CutOutOptions, OutputOption):
    """Convert a robot, a URDF with its loops, or a printer's configuration to a YAML.

    For a robot it prints a commented YAML of bodies, joints and rods. It is a complete robot: edit
    it, and use its path in place of a robot's name.

    For a linear Delta printer it writes the geometry and the probings, for `calibrate`. Klipper: a
    printer.cfg after DELTA_CALIBRATE or DELTA_ANALYZE and SAVE_CONFIG. Marlin: M665, M666 and the
    first table of G33. RepRapFirmware: M665, M666, and the `G30 P` lines of bed.g with the reply to
    G32, or heightmap.csv. Smoothieware: M665, M666, and the X, Y, Z lines of G29.1. Several files
    are read as one text.
    """

    source: tuple[str, ...] = setting(
        ...,
        f"{ROBOT_HELP}; or a printer's printer.cfg, log of M503, M665, M666 and probings, heightmap.csv",
        argument=True,
    )
    out: Path | None = setting(None, "the robot file; default: print, of a printer printer.yaml", writes=True)
    data: Path | None = setting(None, "a printer's measurements, a CSV; default: probes.csv", writes=True)
    firmware: Firmware | None = setting(
        None, "of a printer; default: detected", choices={one.value: one for one in Firmware}
    )
    probe_radius: float | None = setting(None, "of G33's points, mm; default: B of M665", low=1.0)


@command("Robots")
def convert(given: Convert) -> Report:
    """Write the YAML of a robot, or of a printer with its measurements.

    :raises PkmTwinError: a file that cannot be read.
    """
    first = given.source[0]
    ending = Path(first).suffix
    if len(given.source) > 1 or (
        ending not in (".yaml", ".yml", ".xacro", *TREE_SUFFIXES) if ending else Path(first).is_file()
    ):
        # Write a printer's geometry and probings.
        out, data = given.out or Path("printer.yaml"), given.data or Path("probes.csv")
        for target in (out, data):
            reject_existing(target, given.overwrite)
        paths = [Path(name) for name in given.source]
        texts = []
        for path in paths:
            try:
                with open_regular(path) as file:
                    texts.append(file.read(64 * 1024**2).decode("utf-8-sig", "replace"))
            except OSError as error:
                raise FileError(path, error, "a text file") from None
        found = read_printer("\n".join(texts), given.firmware, given.probe_radius)
        replace_file(out, found.yaml(f"A printer's geometry, read from {one_line(paths[0].name, 100)}").encode())
        replace_file(data, found.table().encode())
        counts = {"height": len(found.heights), "distance": len(found.distances)}
        kinds = [name for name, count in counts.items() if count]
        return Report(
            f"linear Delta, radius {found.radius:g} mm, {counts['height']} heights, {counts['distance']} distances",
            [Fact("radius", found.radius * 1e-3, "m"), Fact("counts", counts)],
            notes=[f"next: pkm-twin calibrate {out} {data} --measure {','.join(kinds)}"],
            files={"out": out, "data": data},
        )
    if not ending and first not in robot_names():
        raise UnknownNameError("SOURCE", first, [*robot_names(), "a robot's or a printer's file"])
    from pkm_twin.machine.machine_yaml import describe_machine_yaml
    from pkm_twin.robot.robot_urdf import expand_tolerances, robot_description
    from pkm_twin.robot.urdf_read import read_urdf

    told, notes = list[str](), list[str]()
    if ending in TREE_SUFFIXES:
        described = read_urdf(Path(first), **given.part)
    else:
        robot = load(first, **given.part)
        described, told = robot_description(robot), robot.book.describe()
        carried = {*described.get("tolerances", ())} | {*expand_tolerances(robot)}
        lost = sorted({*robot.tolerances} - carried)
        if lost:
            notes = [f"left out, not numbers of these parts: tolerances of {', '.join(lost)}"]
    text = describe_machine_yaml(described, told + notes)
    if given.out is None:
        return Report(facts=[Fact("yaml", text)], raw=text, notes=notes)
    replace_file(given.out, text.encode())
    return Report(files={"out": given.out}, notes=notes)
