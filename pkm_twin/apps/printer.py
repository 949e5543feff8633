# SPDX-License-Identifier: Apache-2.0
"""``pkm-twin printer`` and ``pkm-twin export printer``: a Delta printer's configuration."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Optional

import typer

from pkm_twin.apps.options import RobotName
from pkm_twin.apps.printer_files import Firmware, printer_of, read_printer, written
from pkm_twin.console import refuse_existing
from pkm_twin.errors import FileError, one_line
from pkm_twin.files import open_regular, replace_file
from pkm_twin.options import OptionalFloat, OptionalPath, file_name

MAX_BYTES = 64 * 1024**2


def printer_command(
    files: Annotated[
        list[Path],
        typer.Argument(help="printer.cfg, a log of M503, M665, M666 and probings, heightmap.csv"),
    ],
    out: Annotated[Path, typer.Option(help="the robot file, a YAML", callback=file_name)] = Path(
        "printer.yaml"
    ),
    data: Annotated[Path, typer.Option(help="the measurements, a CSV", callback=file_name)] = Path(
        "probes.csv"
    ),
    firmware: Annotated[
        Optional[Firmware],  # noqa: UP045  typer of Ubuntu 24.04 reads no unions
        typer.Option(help="of the files; default: by what they contain"),
    ] = None,
    probe_radius: Annotated[
        OptionalFloat, typer.Option(min=1.0, help="of G33's points, mm; default: B of M665")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace the files")] = False,
) -> None:
    """Read a linear Delta printer's geometry and probings for `calibrate`.

    Klipper: a printer.cfg after DELTA_CALIBRATE or DELTA_ANALYZE and SAVE_CONFIG. Marlin: M665,
    M666 and the first table of G33. RepRapFirmware: M665, M666, and the `G30 P` lines of bed.g
    with the reply to G32, or heightmap.csv. Smoothieware: M665, M666, and the X, Y, Z lines of
    G29.1. Several files are read as one text.
    """
    for target in (out, data):
        refuse_existing(target, overwrite)
    texts = []
    for path in files:
        try:
            with open_regular(path) as file:
                texts.append(file.read(MAX_BYTES).decode("utf-8-sig", "replace"))
        except OSError as error:
            raise FileError(path, error, "a text file") from None
    found = read_printer("\n".join(texts), firmware, probe_radius)
    head = f"A printer's geometry, read from {one_line(files[0].name, 100)}"
    replace_file(out, found.yaml(head).encode())
    replace_file(data, found.table().encode())
    kinds = [
        name
        for name, rows in (("height", found.heights), ("distance", found.distances))
        if len(rows)
    ]
    typer.echo(f"{out}: linear Delta, radius {found.radius:g} mm")
    typer.echo(f"{data}: {len(found.heights)} heights, {len(found.distances)} distances")
    typer.echo(f"next: pkm-twin calibrate {out} {data} --measure {','.join(kinds)}")


def export_printer(
    robot: RobotName,
    firmware: Annotated[
        Firmware,
        typer.Option(help="klipper, marlin or reprapfirmware; smoothieware cannot be written"),
    ],
    out: Annotated[
        OptionalPath, typer.Option(help="a file; default: print", callback=file_name)
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace the file")] = False,
) -> None:
    """Write a linear Delta's geometry as a printer's configuration.

    Towers are turned about z so that the third is at 90 degrees.
    """
    from pkm_twin import load

    text = written(printer_of(load(robot)), firmware)
    if out is None:
        typer.echo(text, nl=False)
        return
    refuse_existing(out, overwrite)
    replace_file(out, text.encode())
