# SPDX-License-Identifier: Apache-2.0
"""Pictures. matplotlib is imported on first use; every function draws on axes that it is given."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pkm_twin.atlas.store import writing
from pkm_twin.files import replace_file

if TYPE_CHECKING:
    from pkm_twin.apps.demo_report import DynamicsSeries, StiffnessSeries
    from pkm_twin.apps.tracking_report import TrackingSeries

# Okabe and Ito's colours, told apart by colour-blind readers too.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#F0E442", "#000000")


def columns(count: int, rows: int) -> tuple[Any, list[Any]]:
    """A figure of ``count`` columns with ``rows`` axes each."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(
        rows, count, figsize=(8 * count, 3 * rows), squeeze=False, layout="constrained"
    )
    return figure, list(axes.T)


def rendered(figure: Any, dpi: int, form: str = "png") -> bytes:
    """A figure as an image; it is closed.

    Names of files and joints may have a dollar in them: no text that is set here is a formula.
    """
    from matplotlib import pyplot

    texts = [] if figure._suptitle is None else [figure._suptitle]
    for ax in figure.axes:
        legend = ax.get_legend()
        texts += [ax.title, ax.xaxis.label, ax.yaxis.label, *ax.texts]
        texts += [] if legend is None else legend.get_texts()
    for text in texts:
        text.set_parse_math(False)
    data = io.BytesIO()
    figure.savefig(data, dpi=dpi, format=form)
    pyplot.close(figure)
    return data.getvalue()


def save(figure: Any, path: Path) -> Path:
    """Write a figure as PNG, whole or not at all, and close it.

    :raises AtlasError: the file cannot be written.
    """
    data = rendered(figure, 110)
    with writing(path):
        replace_file(path, data)
    return path


def efforts(axes: Sequence[Any], data: DynamicsSeries) -> None:
    """Measured and predicted efforts of the first joint closely, all joints, and residuals."""
    close, whole, rest = axes
    middle = float(data.time[len(data.time) // 8]) if len(data.time) else 0.0
    near = (data.time >= middle) & (data.time <= middle + 2.0)
    name = data.joints[0]
    close.plot(data.time[near], data.measured[near, 0], color="0.6", lw=2.5, label="recorded")
    close.plot(data.time[near], data.predicted[near, 0], color=COLOURS[1], lw=1, label="twin")
    close.set_title(f"{data.title}\neffort of {name}, two seconds")
    whole.set_title("feedforward efforts")
    rest.set_title("residual: recorded minus predicted")
    for i, joint in enumerate(data.joints):
        whole.plot(data.time, data.predicted[:, i], color=COLOURS[i], lw=0.7, label=joint)
        rest.plot(data.time, data.residual[:, i], color=COLOURS[i], lw=0.5, label=joint)
    if not data.free.all():
        cut = "cutting ± 0.5 s,\nwrench known to the node"
        held = "payload held ± 0.5 s,\nunknown to the node"
        rest.fill_between(
            data.time,
            *(0, 1),
            where=~data.free,
            transform=rest.get_xaxis_transform(),
            color="0.9",
            zorder=0,
            label=cut if data.loaded is None else held,
        )
    for ax in axes:
        ax.set_xlabel("time (s)")
        ax.set_ylabel(f"effort ({data.unit})")
        ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8)
        ax.grid(alpha=0.3)


def deflections(axes: Sequence[Any], data: StiffnessSeries) -> None:
    """Deflection against the frame's, closely and whole, and the strain-energy factors."""
    close, whole, shares = axes
    begin = float(data.time[len(data.time) // 8]) if len(data.time) else 0.0
    for ax, span in ((close, (begin, begin + 0.6)), (whole, (-1.0, np.inf))):
        part = (data.time >= span[0]) & (data.time <= span[1])
        true = (data.truth_time >= span[0]) & (data.truth_time <= span[1])
        for i, axis in enumerate("xyz"):
            ax.plot(
                data.time[part],
                1e6 * data.deflection[part, i],
                color=COLOURS[i],
                lw=0.8,
                label=f"{axis}, twin",
            )
            ax.plot(
                data.truth_time[true],
                1e6 * data.truth[true, i],
                "o",
                color=COLOURS[i],
                ms=4 if ax is close else 2,
                mec="black",
                mew=0.4,
                label=f"{axis}, finite-element frame",
            )
        ax.set_ylabel("deflection (um)")
        ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8)
    close.set_title(f"{data.title}\nplatform deflection, fixed axes, 0.6 seconds")
    whole.set_title("platform deflection, fixed axes")
    if len(data.time):
        # Half-second means: the tooth passing would paint the whole area.
        width = max(1, round(0.5 * len(data.time) / (data.time[-1] - data.time[0])))
        usable = len(data.time) // width * width
        means = data.factors[:usable].reshape(-1, width, len(data.elements)).mean(1)
        middles = data.time[:usable].reshape(-1, width).mean(1)
        colours = [COLOURS[i // 3] for i in range(len(data.elements))]
        bands = shares.stackplot(middles, means.T, labels=data.elements, colors=colours)
        for i, band in enumerate(bands):
            band.set_alpha((1.0, 0.65, 0.35)[i % 3])
            band.set_edgecolor("white")
    shares.set_ylabel("strain-energy factor")
    shares.set_ylim(0, 1)
    shares.set_title("strain-energy factors, mean over 0.5 s")
    shares.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8)
    for ax in axes:
        ax.set_xlabel("time (s)")
        ax.grid(alpha=0.3)


def tracking(axes: Sequence[Any], data: TrackingSeries) -> None:
    """Tracking errors of PD alone and with feedforward, and the first joint's efforts."""
    least = min(data.runs)
    together, ahead, efforts = axes
    for i, (spread, (plain, fed)) in enumerate(data.runs.items()):
        told = f"{100 * spread:g} %"
        for ax, run, what in ((together, plain, "PD"), (ahead, fed, "with feedforward")):
            size = 1e3 * np.linalg.norm(run.error, axis=1)
            ax.plot(run.time, size, color=COLOURS[i], lw=1.2, label=f"{what}, {told}")
        together.plot(
            fed.time,
            1e3 * np.linalg.norm(fed.error, axis=1),
            *("--",),
            color=COLOURS[i],
            lw=1,
            label=f"with feedforward, {told}",
        )
    for i, (run, what) in enumerate(zip(data.runs[least], ("PD", "with feedforward"), strict=True)):
        for k, joint in enumerate(data.joints):
            label = f"{joint}, {what}"
            style = {"lw": 1.0, "ls": ("-", "--")[i], "color": COLOURS[k]}
            efforts.plot(run.time, run.effort[:, k], label=label, **style)
    together.set_title("machine_sim: tracking error of a path there and back, by parameter error")
    ahead.set_title("the same with feedforward, closely")
    efforts.set_title(f"drives' efforts at {100 * least:g} %")
    for ax in axes:
        ax.set_xlabel("time (s)")
        ax.set_ylabel("effort (N m)" if ax is efforts else "error, all joints (mrad)")
        ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8)
        ax.grid(alpha=0.3)


def torques(motion: Any, table: Mapping[str, Any]) -> Any:
    """Efforts and their terms, an axes for each actuated joint; grey where beyond the limits."""
    robot = motion.robot
    figure, axes = columns(1, len(robot.joint_names))
    terms = ("gravity", "inertia", "velocity", "payload", "friction", "external")
    for ax, joint, unit in zip(axes[0], robot.joint_names, robot.effort_units, strict=True):
        if motion.measured is not None:
            ax.plot(table["time"], table[f"{joint}.measured"], color="0.7", lw=2, label="measured")
        ax.plot(table["time"], table[f"{joint}.effort"], color="black", lw=1, label="sum")
        if f"{joint}.effort_deviation" in table:
            band = 2.0 * table[f"{joint}.effort_deviation"]
            low, high = (table[f"{joint}.effort"] + sign * band for sign in (-1.0, 1.0))
            label = "two deviations"
            ax.fill_between(table["time"], low, high, color="0.3", alpha=0.25, lw=0, label=label)
        for colour, term in zip(COLOURS, terms, strict=False):
            values = table[f"{joint}.effort_{term}"]
            if np.any(values != 0.0):
                ax.plot(table["time"], values, color=colour, lw=0.8, label=term)
        if "beyond_limits" in table:
            ax.fill_between(
                table["time"],
                *(0, 1),
                where=np.asarray(table["beyond_limits"]) > 0,
                transform=ax.get_xaxis_transform(),
                color="0.85",
                zorder=0,
                label="beyond limits",
            )
        ax.set_title(f"{robot.name}: effort of {joint}")
        ax.set_xlabel("time (s)")
        ax.set_ylabel(f"effort ({unit})")
        ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8)
        ax.grid(alpha=0.3)
    return figure
