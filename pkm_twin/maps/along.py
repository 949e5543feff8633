# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Evaluate a kind of map along a path: values over time, and the worst sample."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pkm_twin.codegen.arrays import Array
from pkm_twin.maps import figures
from pkm_twin.maps.kind import Case, Found, Kind, concatenate_found, evaluate_kind
from pkm_twin.maps.sweep import check
from pkm_twin.report import plots
from pkm_twin.robot.robot import Robot
from pkm_twin.robot.workspace import belong_to_workspace

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False)
class Along:
    """Hold a kind's values along a path: ``time`` (k,), s; ``pose`` (k, m); ``found`` per case.

    ``counted``: which samples keep all limits and a singularity index of ``least``, shape (k,);
    ``near_singular``: how many have a smaller index. ``loaded``: whether the path's wrench acts.
    ``elements``: names that ``found`` indexes.
    """

    robot: Robot
    kind: Kind
    cases: tuple[Case, ...]
    time: Array
    pose: Array
    least: float
    counted: NDArray[np.bool_]
    found: Sequence[Found]
    elements: tuple[str, ...]
    near_singular: int
    loaded: bool

    @property
    def worst(self) -> list[dict[str, Any]]:
        """Worst sample of each case as plain data, as for a stored map, with its time."""
        answers, axes = [], self.kind.axes(self.robot)
        for case, one in zip(self.cases, self.found, strict=True):
            k = int(np.nanargmax(one.value if case.largest else -one.value))
            answer: dict[str, Any] = {
                "case": case.name,
                "what": case.what,
                "answer": case.answer,
                "value": float(one.value[k]),
                "unit": case.unit,
                "time_s": float(self.time[k]),
                "pose": dict(zip(self.robot.pose_names, self.pose[k].tolist(), strict=True)),
                "pose_units": dict(zip(self.robot.pose_names, self.robot.pose_units, strict=True)),
            }
            if one.direction is not None and axes:
                answer |= {"direction": one.direction[k].tolist(), "axes": list(axes)}
            if one.element is not None and self.elements:
                answer["element"] = self.elements[int(one.element[k])]
            answers.append(answer)
        return answers

    @property
    def sentences(self) -> list[str]:
        """Worst sample of each case in words."""
        return [
            ("" if len(self.cases) == 1 else f"{one['case']}: ")
            + f"{figures.write_sentence(one)}; at {one['time_s']:.4g} s"
            for one in self.worst
        ]

    def table(self) -> str:
        """Return a CSV of each case's value, direction and element over time."""
        header = ["time", *self.robot.pose_names, "counts"]
        columns: list[list[Any]] = [self.time.tolist(), *self.pose.T.tolist(), self.counted.astype(int).tolist()]
        for case, one in zip(self.cases, self.found, strict=True):
            before = "" if len(self.cases) == 1 else f"{case.name}."
            header.append(f"{before}value")
            columns.append(one.value.tolist())
            if one.direction is not None and one.direction.shape[-1] == 3:
                header += [f"{before}direction.{axis}" for axis in "xyz"]
                columns += one.direction.T.tolist()
            if one.element is not None and self.elements:
                header.append(f"{before}element")
                columns.append([self.elements[k] for k in one.element])
        text = io.StringIO()
        csv.writer(text).writerows([header, *zip(*columns, strict=True)])
        return text.getvalue()

    def draw(self) -> Figure:
        """Draw the values of each case over time, coloured by the critical element."""
        indices = [one.element for one in self.found if one.element is not None and self.elements]
        # An element has one colour in all panels.
        blamed = np.unique(np.concatenate(indices)).tolist() if indices else []
        figure, ((*axes,),) = plots.make_subplots(1, len(self.found))
        for ax, case, one, text in zip(axes, self.cases, self.found, self.sentences, strict=True):
            scale, unit = figures.choose_prefix(float(np.nanmax(np.abs(one.value))), case.unit)
            values = scale * one.value
            ax.plot(self.time, values, color="0.7", lw=1)
            for n, element in enumerate(blamed):
                own = one.element == element
                if np.any(own):
                    colour = plots.COLOURS[n % len(plots.COLOURS)]
                    dots = ax.plot(self.time[own], values[own], ".", ms=4, color=colour)
                    dots[0].set_label(self.elements[element])
            plots.label(ax, "time (s)", f"{case.what} ({unit})", text, 9)
            if blamed:
                plots.legend(ax)
        plots.write_title(figure, f"{self.robot.name}: {self.kind.question}", 10)
        return figure


def along(
    kind: Kind,
    robot: Robot,
    time: Array,
    q: Array,
    *,
    cases: Sequence[Case] = (),
    least: float | None = None,
    least_clearance: float = 0.0,
    parts: Iterable[tuple[Robot, slice]] = (),
    wrench: Array | None = None,
) -> Along:
    """Evaluate a kind at joint positions q (k, n) at times (k,), s.

    :param cases: load cases; by default the kind's own.
    :param least: singularity index below which a sample does not count; by default the kind's.
    :param parts: the robot with its payload, and for which samples, in order.
    :param wrench: on the platform, base axes, N and N m, shape (k, 6); it replaces the kind's own
        load case if the kind takes wrenches and no cases are given.
    :raises ParameterError: the robot's file lacks what the quantity needs.
    """
    chosen = tuple(cases) or kind.cases(robot)
    if cases or not kind.takes_wrench or wrench is None or not wrench.any():
        wrench = None
    else:
        chosen = (kind.loaded(robot, "wrench of the path", wrench[wrench.any(1)][0].tolist()),)
    check(robot, kind, chosen)
    pose = robot.forward(q)
    known = np.ones(len(pose), bool)
    least = kind.least if least is None else least
    counted = belong_to_workspace(robot, q, pose, known, least, least_clearance)
    changes: list[int] = []
    if wrench is not None:
        changes = (1 + np.flatnonzero((wrench[1:] != wrench[:-1]).any(1))).tolist()
    pieces, elements = [], dict[str, int]()
    for loaded, rows in parts or [(robot, slice(0, len(q)))]:
        # A payload is an element of its own where there is one.
        names = [elements.setdefault(name, len(elements)) for name in kind.elements(loaded)]
        index = np.array([*names, -1])
        inside = [k for k in changes if rows.start < k < rows.stop]
        for begin, end in pairwise([rows.start, *inside, rows.stop]):
            under = chosen
            if wrench is not None:
                load = tuple(wrench[begin].tolist())
                under = tuple(replace(case, wrench=load) for case in chosen)
            values = evaluate_kind(kind, loaded, q[begin:end], under)
            pieces.append([one if one.element is None else one._replace(element=index[one.element]) for one in values])
    found = [concatenate_found(each) for each in zip(*pieces, strict=True)]
    low = int((robot.try_singularity(q[~counted])[0] < least).sum())
    return Along(robot, kind, chosen, time, pose, least, counted, found, tuple(elements), low, wrench is not None)
