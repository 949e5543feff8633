# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Draw how a limb is solved for a pose: ``python -m tools.pages.limbs OUT.png``."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from pkm_twin import load
from pkm_twin.report import plots

POSE = (0.06, 0.33)
"""Pose of a five-bar's tip, x and z, m, away from home to show the motion."""
GREY = "0.6"


def draw_link(ax, ends, colour="black", style="-"):
    """Draw a body between two joints."""
    ax.plot(*np.transpose(ends), style, color=colour, linewidth=2.5, zorder=2)
    ax.plot(*np.transpose(ends), "o", color=colour, markerfacecolor="white", zorder=3)


def draw_circle(ax, centre, radius):
    """Draw a circle of possible places."""
    angle = np.linspace(0.0, 2.0 * np.pi, 200)
    places = np.add(centre, radius * np.column_stack([np.cos(angle), np.sin(angle)]))
    ax.plot(*places.T, "--", color=GREY, linewidth=1.0)


def name(ax, place, text, side):
    """Write a name beside a place."""
    ax.annotate(text, place, np.multiply(side, 8.0), textcoords="offset points", ha="center", va="center", fontsize=11)


def draw(path):
    """Draw three steps: the pose places the platform, the reach meets its distance, J follows."""
    robot = load("five_bar")
    joints, plane = robot.graph.joints, np.array([0, 2])
    motor, elbow, tip = (joints[n].at[plane] for n in ("left", "elbow_left", "tip"))
    other = [joints[n].at[plane] for n in ("right", "elbow_right")]
    goal = np.array(POSE)
    moved = robot.inverse(goal)[0] - joints["left"].home

    def turn(vector, angle):
        """Rotate about y, in the plane of x and z."""
        c, s = np.cos(angle), np.sin(angle)
        return np.array([c * vector[0] + s * vector[1], c * vector[1] - s * vector[0]])

    found = motor + turn(elbow - motor, moved)
    blue, red = plots.COLOURS[:2]
    figure, ((first,), (second,), (third,)) = plots.make_subplots(3, 1, 3.2)
    for ax, title in (
        (first, "1. the pose places the platform"),
        (second, "2. reach: one distance"),
        (third, "3. turn: one direction"),
    ):
        ax.set_title(title, fontsize=11)
        ax.set_aspect("equal")
        ax.axis("off")
        ax.set_xlim(-0.31, 0.26)
        ax.set_ylim(-0.06, 0.42)
        ax.plot([-0.1, 0.1], [0.0, 0.0], color=GREY, linewidth=1.0)
    for ends in ((motor, elbow), (elbow, tip), (tip, other[1]), (other[1], other[0])):
        draw_link(first, ends, GREY)
    arrow = {"arrowstyle": "-|>", "color": red, "linewidth": 1.8, "shrinkA": 0, "shrinkB": 0}
    corner = np.array([goal[0], 0.0])
    first.annotate("", corner, (0.0, 0.0), arrowprops=arrow)
    first.annotate("", goal, corner, arrowprops=arrow)
    first.plot(*goal, "o", color=red, zorder=4)
    name(first, 0.5 * corner, "x", (0, -1.2))
    name(first, [goal[0], 0.16], "z", (1.2, 0))
    name(first, goal, "J", (1.4, 0.6))
    draw_circle(second, motor, np.hypot(*(elbow - motor)))
    draw_circle(second, goal, np.hypot(*(tip - elbow)))
    draw_link(second, (motor, elbow), GREY)
    draw_link(second, (motor, found), blue)
    name(second, motor, "drive, t", (0.2, -1.6))
    name(second, found, "C", (-1.5, 0.6))
    draw_link(third, (motor, found), blue)
    draw_link(third, (found, found + turn(tip - elbow, moved)), GREY)
    draw_link(third, (found, goal), blue)
    name(third, found, "C", (-1.5, 0.6))
    for ax in (second, third):
        ax.plot(*goal, "o", color=red, zorder=4)
        name(ax, goal, "J", (1.4, 0.6))
    plots.save(figure, path, 110)


if __name__ == "__main__":
    draw(Path(sys.argv[1]))
