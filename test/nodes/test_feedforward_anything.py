# SPDX-License-Identifier: Apache-2.0
"""Random messages to the feedforward core: an error, or finite efforts."""

import math

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, event, given, settings
from hypothesis import strategies as st

from pkm_twin.errors import MessageError
from test.nodes.feedforward_core import NAMES, NOW, ORDERS, ROBOT, STEP, WINDOW, core, sample
from test.nodes.harness import SECOND, Maker, Plain

pytestmark = pytest.mark.filterwarnings("error")

NUMBERS = st.one_of(
    st.floats(-1.0, 1.0),
    st.floats(),
    st.sampled_from([math.nan, math.inf, -math.inf, 1e308, -1e308, 5e-324, -0.0, 1e7, 1e18]),
)
GOOD = st.floats(-0.9, 1.3, allow_subnormal=False)


@st.composite
def trajectories(draw):
    """A good trajectory, or one with up to three things changed into anything."""
    make = Maker(Plain())
    count = draw(st.integers(1, 4))
    rows = st.lists(st.tuples(GOOD, GOOD, GOOD), min_size=count, max_size=count)
    steps = draw(st.lists(st.integers(1, 2 * SECOND), min_size=count, max_size=count))
    message = make.trajectory(
        draw(st.permutations(NAMES)),
        [int(time) for time in np.cumsum(steps)],
        draw(rows),
        draw(st.one_of(rows, rows, rows, st.none())),
        draw(st.one_of(rows, rows, rows, st.none())),
    )
    for _ in range(draw(st.sampled_from([0, 1, 1, 2]))):
        what = draw(
            st.sampled_from(["names", "time", "stamp", "points", "length", "value", "value"])
        )
        point = message.points[draw(st.integers(0, count - 1))] if message.points else None
        if what == "names":
            message.joint_names = draw(
                st.lists(st.one_of(st.sampled_from(NAMES), st.text(max_size=4)), max_size=4)
            )
        elif what == "stamp":
            seconds, nanoseconds = draw(
                st.tuples(st.integers(-10, 2**31 - 1), st.integers(0, 2**32))
            )
            message.header.stamp = make.kind.time(sec=seconds, nanosec=nanoseconds)
        elif what == "points":
            message.points = []
        elif point is not None and what == "time":
            seconds = draw(st.integers(-(2**31), 2**31 - 1))
            point.time_from_start = make.kind.duration(
                sec=seconds, nanosec=draw(st.integers(0, 2**32 - 1))
            )
        elif point is not None:
            values = draw(st.sampled_from(["positions", "velocities", "accelerations"]))
            changed = list(getattr(point, values)) or [0.0] * 3
            if what == "length":
                changed = draw(st.lists(NUMBERS, max_size=5))
            else:
                changed[draw(st.integers(0, len(changed) - 1))] = draw(NUMBERS)
            setattr(point, values, changed)
    return message


class TestAnything:
    """Whatever comes: a MessageError, or finite efforts; never another exception, never NaN."""

    relaxed = settings(
        max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
    )

    @relaxed
    @given(
        message=trajectories(),
        differentiate=st.booleans(),
        policy=st.sampled_from(["warn", "reject", "clamp"]),
        limited=st.booleans(),
    )
    def test_trajectories(self, limitless, message, differentiate, policy, limited):
        twin = core(
            ROBOT if limited else limitless, differentiate=differentiate, limit_policy=policy
        )
        try:
            efforts = twin.trajectory(message, NOW)
        except MessageError as error:
            event(error.reason)
            assert sum(twin.trajectories.rejected.values()) == 1
            return
        event("answered")
        assert efforts.shape == (len(message.points), 3)
        assert np.isfinite(efforts).all()

    @relaxed
    @given(
        spoils=st.dictionaries(
            st.integers(0, 4 * WINDOW - 1),
            st.fixed_dictionaries(
                {},
                optional={
                    "position": st.lists(NUMBERS, min_size=3, max_size=3),
                    "velocity": st.lists(NUMBERS, min_size=3, max_size=3),
                    "effort": st.lists(NUMBERS, max_size=4),
                    "stamp": st.integers(NOW - SECOND, NOW + SECOND),
                },
            ),
            max_size=6,
        ),
        steps=st.lists(
            st.one_of(st.just(1), st.just(STEP), st.integers(1, SECOND // 20)),
            min_size=4 * WINDOW,
            max_size=4 * WINDOW,
        ),
        limited=st.booleans(),
        rates=st.booleans(),
    )
    def test_streams(self, limitless, spoils, steps, limited, rates):
        make = Maker(Plain())
        twin = core(ROBOT if limited else limitless, differentiate=True, recovery_count=1)
        now, last = NOW, 0
        for i, step in enumerate(steps):
            now += step
            message, _ = sample(make, i, rates=rates, **({"stamp": now} | spoils.get(i, {})))
            try:
                result = twin.joint_state(message, now)
            except MessageError as error:
                event(error.reason)
                continue
            if result is None:
                continue
            event("answered")
            assert np.isfinite(result.effort).all()
            assert result.residual is None or np.isfinite(result.residual).all()
            assert result.stamp > last
            last = result.stamp

    @relaxed
    @given(
        rows=st.lists(st.tuples(*[GOOD] * 9), min_size=3, max_size=4),
        steps=st.lists(st.integers(SECOND // 2, SECOND), min_size=4, max_size=4),
        present=st.integers(1, 3),
        order=st.sampled_from(ORDERS),
    )
    def test_permuted_trajectories(self, rows, steps, present, order):
        make = Maker(Plain())
        values = np.array(rows).reshape(-1, 3, 3).swapaxes(0, 1)[:present]
        times = [int(time) for time in np.cumsum(steps[: len(rows)])]
        message = make.trajectory(NAMES, times, *values)
        twin = core(differentiate=True)
        try:
            efforts = twin.trajectory(message, NOW)
        except MessageError:
            assume(False)
        names = [NAMES[i] for i in order]
        permuted = make.trajectory(names, times, *values[..., order])
        assert (twin.trajectory(permuted, NOW) == efforts[:, order]).all()
