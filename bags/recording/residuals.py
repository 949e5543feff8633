# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""What is left of a recording's efforts when a model and a smooth acceleration are taken away.

``python -m bags.recording.residuals`` writes the figures into bags/README.md, a test compares them.
"""

from __future__ import annotations

import functools
import re
from pathlib import Path
from textwrap import fill
from typing import Any, Final

import numpy as np
import scipy
from numpy.typing import NDArray

from delta_dynamics import inverse_dynamics
from pkm_twin.bags.reader import read_messages
from pkm_twin.recordings import Recording, read

Array = NDArray[np.float64]
BAGS: Final = Path(__file__).resolve().parents[1]
PAGE: Final = BAGS / "README.md"
DEGREE: Final = 2
"""Of the polynomial over the velocity."""
AROUND: Final = 0.5
"""Seconds around a pick, a release and a cut that count for neither side."""
SLOW: Final = 20.0
"""Hz; what is slower is no line of the teeth."""


@functools.cache
def recorded(name: str) -> Recording:
    """A recording by its name."""
    return read(BAGS / f"{name}.mcap")


def accelerations(qd: Array, period: float, window: int, newest: bool) -> Array:
    """From joint rates (samples, n), by a quadratic through ``window`` of them; NaN at the ends.

    Read off at the window's middle, or at its newest sample, where no future is needed.
    """
    at = window - 1 if newest else window // 2
    weights = scipy.signal.savgol_coeffs(window, DEGREE, deriv=1, delta=period, pos=at, use="dot")
    found = np.full_like(qd, np.nan)
    rates = np.lib.stride_tricks.sliding_window_view(qd, window, axis=0) @ weights
    found[at : at + len(rates)] = rates
    return found


def residual(r: Recording, qdd: Array, wrench: Array | None = None) -> Array:
    """Recorded minus computed efforts (samples, n), zero where there is no acceleration."""
    assert r.qd is not None and r.effort is not None
    known = np.isfinite(qdd).all(1)
    loads = np.zeros((len(r.time), 6)) if wrench is None else wrench
    left = np.zeros_like(r.effort)
    state = (r.q[known], r.qd[known], qdd[known], loads[known])
    left[known] = r.effort[known] - inverse_dynamics(r.robot, *state)
    return left


def share(values: Array, peak: float) -> float:
    """Root mean square over samples and joints, % of a peak."""
    return 100.0 * float(np.sqrt(np.mean(values**2))) / peak


def pick_and_place() -> str:
    """The table of the Delta's recording."""
    r = recorded("delta_cu_pick_and_place")
    assert r.load is not None and r.qd is not None and r.effort is not None
    near = r.load.near_change(r.time, AROUND)
    held = r.load.is_on_platform(r.time) & ~near
    free = ~r.load.is_on_platform(r.time) & ~near
    peak = float(np.abs(r.effort[free]).max())
    rows = ["| window (ms) | read off at its middle | at its newest end |", "|---|---|---|"]
    for window in (31, 41, 51, 61):
        left = [residual(r, accelerations(r.qd, 1e-3, window, newest)) for newest in (False, True)]
        cells = (f"{share(values[free], peak):.1f} %" for values in left)
        rows.append(f"| {window} | {' | '.join(cells)} |")
    loaded = residual(r, accelerations(r.qd, 1e-3, 41, False))[held]
    rms = float(np.sqrt(np.mean(loaded**2)))
    text = (
        f"Shares are of the peak torque without payload, {peak:.2f} N m. With the payload "
        f"unaccounted for the residual is {rms:.2f} N m rms, {share(loaded, peak):.0f} % of it "
        "(41 ms, middle)."
    )
    return "\n".join([*rows, "", fill(text, 100)])


def lifts() -> str:
    """How many of the commanded moves go up on their way."""
    r = recorded("delta_cu_pick_and_place")
    moves = read_messages(BAGS / "delta_cu_pick_and_place.mcap", ["/delta_dynamics/joint_trajectory"])
    heights = []
    for move in moves:
        z = r.robot.forward(np.array([p.positions for p in move.message.points]))[:, 2]
        heights.append(float(z.max() - max(z[0], z[-1])))
    up = [height for height in heights if height > 1e-3]
    return fill(
        f"Of the {len(heights)} moves {len(up)} lift the platform by {1e3 * np.mean(up):.0f} mm; "
        "those from and to the home pose go straight.",
        100,
    )


def milling() -> str:
    """The table of the 3-PRRU's recording."""
    r = recorded("prru_milling")
    assert r.qd is not None and r.effort is not None
    passes = ((2.0, 9.4), (11.5, 18.9))
    cut = np.logical_or.reduce([(r.time > a) & (r.time < b) for a, b in passes])
    near = np.logical_or.reduce([(r.time > a - AROUND) & (r.time < b + AROUND) for a, b in passes])
    peak = float(np.abs(r.effort).max())
    low: Any = scipy.signal.butter(4, SLOW, fs=1000.0, output="sos")
    rows = [
        "| window (ms) | out of the cut | in it, wrench left out | in it, with the wrench | "
        f"of that slower than {SLOW:g} Hz |",
        "|---|---|---|---|---|",
    ]
    for window in (5, 41):
        qdd = accelerations(r.qd, 1e-3, window, False)
        bare, known = residual(r, qdd), residual(r, qdd, r.wrench)
        slow = np.asarray(scipy.signal.sosfiltfilt(low, known, axis=0))
        cells = (share(bare[~near], peak), share(bare[cut], peak), share(known[cut], peak))
        text = " | ".join(f"{cell:.1f} %" for cell in cells)
        rows.append(f"| {window} | {text} | {share(slow[cut], peak):.2f} % |")
    return "\n".join([*rows, "", f"Shares are of the peak force, {peak:.0f} N."])


SECTIONS: Final = {"lifts": lifts, "pick_and_place": pick_and_place, "milling": milling}


def put(page: str, name: str, text: str) -> str:
    """The page with what stands between the marks of ``name`` replaced."""
    begin, end = f"<!-- printed: {name} -->", "<!-- end -->"
    pattern = re.compile(f"{re.escape(begin)}.*?{re.escape(end)}", re.DOTALL)
    assert len(pattern.findall(page)) == 1, name
    return pattern.sub(lambda _: f"{begin}\n{text}\n{end}", page)


def main() -> None:
    """Write the figures into the page."""
    page = PAGE.read_text(encoding="utf-8")
    for name, make in SECTIONS.items():
        page = put(page, name, make())
    PAGE.write_text(page, encoding="utf-8")


if __name__ == "__main__":
    main()
