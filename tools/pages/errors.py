# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Write a part of docs/errors.md from the classes: ``python -m tools.pages.errors docs/errors.md``."""

from __future__ import annotations

import ast
import sys
from pathlib import Path

from pkm_twin import errors, robot_names
from pkm_twin.bags.reader import DamagedBagError
from test.support.pages import write_section

ROOT = Path(__file__).parents[2]
HEAD = """All errors are subclasses of `PkmTwinError`, one line each: what is wrong, where, what is
expected ([attributes](api.md#errors)). Nodes reject the message and count it by its reason in
`/diagnostics`. Examples:

"""
ERRORS = {
    errors.ParameterError: (
        errors.ParameterError("geometry.arm_length", -0.2, "a finite number, 1e-06 to 100 m"),
        "see [robot files](parameters.md)",
    ),
    errors.FileError: (
        errors.FileError("poses.csv", FileNotFoundError(), "a CSV file"),
        "check the path and the format",
    ),
    errors.UnknownNameError: (
        errors.UnknownNameError("robot", "delt", robot_names()),
        "use the suggested name",
    ),
    errors.MissingExtraError: (
        errors.MissingExtraError("h5netcdf", "maps"),
        "install the extra that the line names",
    ),
    errors.MobilityError: (
        errors.MobilityError(2, 1, ["elbow_2's axis is 1e-05 rad from parallel to motor_1's axis"]),
        "correct the joint ([new machine](new_machine.md#cross-check-and-errors-of-a-file))",
    ),
    errors.UnreachableError: (
        errors.UnreachableError("pose", "limb 2", (3,), 0.0125),
        "choose a pose inside the workspace (`pkm-twin map ROBOT workspace`)",
    ),
    errors.SingularityError: (
        errors.SingularityError("joint state", (), 2e-9, 1e-6),
        "keep the [singularity index](concepts.md#singularity-index) above 0.05",
    ),
    errors.MessageError: (
        errors.MessageError("not finite", "position of arm_1 is nan"),
        "see the reasons below",
    ),
    errors.BagError: (
        errors.BagError("no topic /wrench", path="run.mcap", reason="no_topic"),
        "the attribute `reason` is a stable code",
    ),
    DamagedBagError: (
        DamagedBagError(
            "the file ends in a chunk",
            path=Path("run.mcap"),
            reason="truncated",
            offset=1_000_000,
            salvageable=1200,
        ),
        "use `pkm-twin recover` ([recordings](recordings.md))",
    ),
}
"""An example of each error class, and its remedy."""
REASONS = {
    "base motion": "only its present motion is known; send joint states",
    "bounds": "beyond any real machine; check the units",
    "busy": "send trajectories more slowly",
    "cdr": "not a message of this type",
    "duplicated joint": "send each joint once",
    "effort limit": "slow the motion, or see `limit_policy`",
    "empty": "no joints, points, positions or efforts",
    "frame": "set `wrench_frame`, or `accept_empty_frame`",
    "future stamp": "synchronise the clocks",
    "jump": "faster than the machine can move; check encoders and stamps",
    "late answer": "took longer than `stale_after`; reduce the load",
    "length": "an array and the names differ; send one value per joint",
    "limit": "beyond position or velocity `limits`",
    "missing joint": "check the names, or use `joint_map`",
    "no base motion": "no fresh `base_imu`, or none with gravity; check its stamps and driver",
    "no pose": "no joint state within `max_state_age` of the wrench; check `joint_states`",
    "no velocities": "set `acceleration` to `differentiate`",
    "no wrench": "none fresh; check topic and stamps",
    "non-finite result": "check the input and the robot file",
    "not finite": "NaN or infinity; check the sensor",
    "not measured": "a covariance of the IMU begins with -1",
    "over": "the trajectory has already ended; use `use_sim_time` for a replayed bag",
    "pose": "of a deflection: check `joint_states`",
    "singular": "see `singularity_stop`",
    "stale stamp": "use `use_sim_time` for a replayed bag",
    "stamp order": "send samples in order",
    "time": "times do not increase, or are invalid",
    "too short": "send at least 3 points to differentiate",
    "transform": "none for the sensor; publish it, or use `sensor.xyz`, `sensor.rpy`",
    "uneven stamps": "too uneven to differentiate",
    "unknown joint": "the robot lacks a joint of the trajectory; see `extra_joints`",
    "unreachable": "cannot be assembled; check the robot file and offsets",
    "unstable control": "of `machine_sim`: lower `bandwidth`, or shorten `period`",
    "zero stamp": "stamp the message, or set `accept_zero_stamp`",
}
"""Reason of a rejected message to its meaning, where the reason does not say it, and the remedy."""


def reasons() -> set[str]:
    """Collect the reasons in the sources; "limit" is "bounds" of a robot with limits."""
    found = {"limit"}
    for folder in ("pkm_twin", "delta_dynamics", "stiffness_monitor"):
        for path in (ROOT / folder).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if not isinstance(node, ast.Call) or ast.unparse(node.func) != "MessageError":
                    continue
                if isinstance(node.args[0], ast.Constant):
                    found.add(node.args[0].value)
    return found


def section() -> str:
    """Write the part of the page."""
    lines = []
    for kind, (example, hint) in ERRORS.items():
        lines.append(f"* **`{kind.__name__}`**: `{example}`: {hint}.")
    heading = "\n\n## Reasons of rejected messages: stale, lost, invalid\n\n"
    rows = [f"* {reason}: {text}" for reason, text in sorted(REASONS.items())]
    return HEAD + "\n".join(lines) + heading + "\n".join(rows)


if __name__ == "__main__":
    write_section("errors", section(), Path(sys.argv[1]))
