# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Closed forms of the inverse kinematics as textbooks have them, in C, for times to compare with.

Each function returns C text of ``int textbook(const double *pose, double *q)`` with a robot's
numbers. Sources: Merlet, Parallel Robots (2006), chapter 3; the 3-RPS by Lee and Shah (1988).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pkm_twin import Robot

HEAD = "static int textbook(const double *pose, double *q)\n{\n"
RPY = """\
    const double cr = cos(pose[{0}]), sr = sin(pose[{0}]), cp = cos(pose[{1}]), sp = sin(pose[{1}]);
"""


def table(name: str, rows: object) -> str:
    """Return a C table of rows of numbers."""
    array = np.atleast_2d(np.asarray(rows, float))
    text = ", ".join("{" + ", ".join(repr(float(x)) for x in row) + "}" for row in array)
    return f"    static const double {name}[{len(array)}][{array.shape[1]}] = {{{text}}};\n"


def legs(robot: Robot) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return feet, heads from the platform's reference point, and home less length of each leg."""
    graph = robot.graph
    feet = [j.at for j in graph.joints.values() if j.kind in ("universal", "revolute")]
    heads = [j.at for j in graph.joints.values() if j.kind == "spherical"]
    length = np.linalg.norm(np.subtract(heads, feet), axis=1)
    home = [graph.joints[name].home for name in graph.actuated]
    return np.array(feet), np.subtract(heads, graph.origin), home - length


def hexapod(robot: Robot) -> str:
    """Six distances between joints of base and platform."""
    feet, heads, offset = legs(robot)
    rows = np.column_stack([feet, heads, offset])
    return (
        HEAD
        + table("leg", rows)
        + RPY.format(3, 4)
        + """\
    const double cy = cos(pose[5]), sy = sin(pose[5]);
    const double r[9] = {cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr,
                         sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr,
                         -sp, cp * sr, cp * cr};
    int i;
    for (i = 0; i < 6; i++) {
        const double *a = leg[i], *b = leg[i] + 3;
        const double x = pose[0] + r[0] * b[0] + r[1] * b[1] + r[2] * b[2] - a[0];
        const double y = pose[1] + r[3] * b[0] + r[4] * b[1] + r[5] * b[2] - a[1];
        const double z = pose[2] + r[6] * b[0] + r[7] * b[1] + r[8] * b[2] - a[2];
        q[i] = sqrt(x * x + y * y + z * z) + leg[i][6];
    }
    return 0;
}
"""
    )


def delta(robot: Robot) -> str:
    """One equation a cos q - z sin q = g in the plane of each arm."""
    g = robot.geometry  # type: ignore[attr-defined]
    rows = np.column_stack([np.cos(g.azimuths), np.sin(g.azimuths)])
    return (
        HEAD
        + table("out", rows)
        + f"""\
    const double l = {float(g.arm_length)!r}, f = {float(g.forearm_length)!r};
    int i;
    for (i = 0; i < 3; i++) {{
        const double a = pose[0] * out[i][0] + pose[1] * out[i][1]
                         + {float(g.platform_radius - g.base_radius)!r};
        const double t = pose[1] * out[i][0] - pose[0] * out[i][1], z = pose[2];
        const double n = a * a + z * z;
        const double c = (n + l * l - f * f + t * t) / (2.0 * l);
        const double s = sqrt(n - c * c);
        q[i] = atan2(-z * c - a * s, a * c - z * s);
    }}
    return 0;
}}
"""
    )


def rps3(robot: Robot) -> str:
    """Yaw, x and y by the planes of three legs at 120 degrees, then three distances."""
    feet, heads, offset = legs(robot)
    angle = np.arctan2(feet[:, 1], feet[:, 0])
    rows = np.column_stack([np.cos(angle), np.sin(angle), feet, heads, offset])
    return (
        HEAD
        + table("leg", rows)
        + RPY.format(1, 2)
        + """\
    double u[3], v[3], w[3], s = 0.0, c = 0.0, x = 0.0, y = 0.0, n;
    int i;
    for (i = 0; i < 3; i++) {
        const double *b = leg[i] + 5;
        u[i] = cp * b[0] + sp * sr * b[1] + sp * cr * b[2];
        v[i] = cr * b[1] - sr * b[2];
        w[i] = pose[0] - sp * b[0] + cp * sr * b[1] + cp * cr * b[2];
        c += leg[i][0] * u[i] + leg[i][1] * v[i];
        s += leg[i][1] * u[i] - leg[i][0] * v[i];
    }
    n = 1.0 / sqrt(c * c + s * s);
    c *= n;
    s *= n;
    for (i = 0; i < 3; i++) {
        const double a = c * u[i] - s * v[i], b = s * u[i] + c * v[i];
        const double t = leg[i][0] * b - leg[i][1] * a;
        u[i] = a;
        v[i] = b;
        x += leg[i][1] * t * (2.0 / 3.0);
        y -= leg[i][0] * t * (2.0 / 3.0);
    }
    for (i = 0; i < 3; i++) {
        const double a = x + u[i] - leg[i][2], b = y + v[i] - leg[i][3], d = w[i] - leg[i][4];
        q[i] = sqrt(a * a + b * b + d * d) + leg[i][8];
    }
    return 0;
}
"""
    )


def five_bar(robot: Robot) -> str:
    """Two triangles of arm and forearm."""
    joints = robot.graph.joints
    rows = []
    for side, name in ((-1.0, "left"), (1.0, "right")):
        pivot, elbow = joints[name].at, joints[f"elbow_{name}"].at
        arm, forearm = elbow - pivot, robot.graph.origin - elbow
        angle = np.arctan2(arm[0], arm[2])
        lengths = [np.hypot(v[0], v[2]) for v in (arm, forearm)]
        rows.append([pivot[0], pivot[2], *lengths, side, joints[name].home - angle])
    return (
        HEAD
        + table("arm", rows)
        + """\
    int i;
    for (i = 0; i < 2; i++) {
        const double x = pose[0] - arm[i][0], z = pose[1] - arm[i][1], n = x * x + z * z;
        const double c = (n + arm[i][2] * arm[i][2] - arm[i][3] * arm[i][3]) / (2.0 * arm[i][2]);
        const double s = arm[i][4] * sqrt(n - c * c);
        q[i] = atan2(x * c + z * s, z * c - x * s) + arm[i][5];
    }
    return 0;
}
"""
    )


def ankle(robot: Robot) -> str:
    """One equation a cos q + b sin q = c of each motor's horn and rod."""
    joints = robot.graph.joints
    rows = []
    for side in ("left", "right"):
        motor, ball = joints[f"{side}_motor"], joints[f"{side}_ball"]
        foot = joints[f"{side}_foot"].at
        rows.append([*motor.at, *(ball.at - motor.at), *(foot - joints["roll"].at), np.sum((ball.at - foot) ** 2)])
    return (
        HEAD
        + table("rod", rows)
        + RPY.format(0, 1)
        + f"""\
    const double up = {float(joints["roll"].at[2] - joints["pitch"].at[2])!r};
    int i;
    for (i = 0; i < 2; i++) {{
        const double *m = rod[i], *h = rod[i] + 3, *b = rod[i] + 6;
        const double w = sr * b[1] + cr * b[2] + up;
        const double x = cp * b[0] + sp * w - m[0], y = cr * b[1] - sr * b[2] - m[1];
        const double z = cp * w - sp * b[0] + {float(joints["pitch"].at[2])!r} - m[2];
        const double a = y * h[1] + z * h[2], c = z * h[1] - y * h[2], n = a * a + c * c;
        const double d = 0.5 * (x * x + y * y + z * z + h[0] * h[0] + h[1] * h[1] + h[2] * h[2]
                                - rod[i][9]) - x * h[0];
        const double s = sqrt(n - d * d) * ((h[1] < 0.0) ? -1.0 : 1.0);
        q[i] = atan2(c * d + a * s, a * d - c * s);
    }}
    return 0;
}}
"""
    )


TEXTBOOK: dict[str, Callable[[Robot], str]] = {
    "stewart": hexapod,
    "delta": delta,
    "rps3": rps3,
    "five_bar": five_bar,
    "ankle": ankle,
}
"""By the robot's name."""
