# SPDX-License-Identifier: Apache-2.0
"""Feed by stiffness: a straight cut that is slower where the machine is softer.

The cutting force is proportional to the feed, F = k v against the motion, and deflects the machine
by C F. To keep the tool within a tolerance, the feed is v = tolerance / (k |C t|), at most the
programmed feed. C is the platform's compliance at the pose, t the direction of the cut. The feed
changes with a limited acceleration. delta_dynamics adds the effort to the trajectory.

    ros2 run pkm_twin machine_sim --ros-args -p mechanism:=delta_cu
    ros2 run pkm_twin delta_dynamics --ros-args -p mechanism:=delta_cu
    python3 feed_rate.py
"""

import argparse
import sys

import numpy as np
import rclpy
from trajectory_client import Client, blend, positions, trajectory

from pkm_twin import load
from pkm_twin.errors import PkmTwinError
from stiffness_monitor import compliance


def feeds(softness, places, feed, tolerance, force_per_feed, acceleration):
    """The feed at places along the cut (m), shape (p,), m/s.

    :param softness: |C t| there, m/N.
    """
    v = np.minimum(feed, tolerance / (force_per_feed * softness))
    v[[0, -1]] = 0.0
    step = np.diff(places)
    for k in range(1, len(v)):
        v[k] = min(v[k], np.sqrt(v[k - 1] ** 2 + 2.0 * acceleration * step[k - 1]))
    for k in range(len(v) - 2, -1, -1):
        v[k] = min(v[k], np.sqrt(v[k + 1] ** 2 + 2.0 * acceleration * step[k]))
    return v


def cut(robot, start, end, options):
    """Times, joint motion and feeds of the cut between two poses, with the deflections.

    :raises PkmTwinError: a pose out of reach, or a robot without elastic members.
    """
    places = np.linspace(0.0, 1.0, 201)
    poses = start + places[:, None] * (end - start)
    points = robot.platform(robot.inverse(poses))[0]
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    along = np.gradient(points, length, axis=0)
    along /= np.linalg.norm(along, axis=1)[:, None]
    soft = np.linalg.norm(
        np.einsum("pij,pj->pi", compliance(robot, poses)[:, :3, :3], along), axis=1
    )
    v = feeds(soft, length, options.feed, options.tolerance, options.force, options.acceleration)
    # v rises with the square root of the way: the mean of two neighbours is exact.
    times = np.concatenate([[0.0], np.cumsum(2.0 * np.diff(length) / (v[1:] + v[:-1]))])
    even = np.linspace(0.0, times[-1], max(101, int(times[-1] / 0.02)))
    q = robot.inverse(start + np.interp(even, times, places)[:, None] * (end - start))
    qd = np.gradient(q, even, axis=0)
    qd[[0, -1]] = 0.0
    return even, q, qd, np.gradient(qd, even, axis=0), v, options.force * v * soft


def main():
    """Cut from home by a difference of poses; print what the tolerance costs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robot", default="delta_cu")
    parser.add_argument(
        "--by", type=float, nargs="+", default=[0.15, 0.0, 0.0], help="cut, in pose coordinates"
    )
    parser.add_argument("--feed", type=float, default=0.2, help="programmed feed, m/s")
    parser.add_argument("--tolerance", type=float, default=1e-4, help="largest deflection, m")
    parser.add_argument("--force", type=float, default=50.0, help="cutting force, N per m/s")
    parser.add_argument("--acceleration", type=float, default=1.0, help="along the cut, m/s2")
    options = parser.parse_args(rclpy.utilities.remove_ros_args()[1:])
    try:
        robot = load(options.robot)
        start, by = robot.home(), np.array(options.by)
        if by.shape != start.shape or not by.any():
            parser.error(f"--by is {options.by}, not a cut in {', '.join(robot.pose_names)}")
        times, *motion, v, bent = cut(robot, start, start + by, options)
    except PkmTwinError as error:
        print(f"failed: {error}", file=sys.stderr)
        return 1
    # Messages use the controller's joint names and values.
    joints = robot.controller
    q = joints.controller_positions(motion[0])
    qd, qdd = (joints.controller_rates(rates) for rates in motion[1:])
    rclpy.init()
    client = Client()
    try:
        client.until(lambda: client.states, 60.0, "joint_states")
        here = positions(client.states[-1], joints.names)
        if abs(here - q[0]).max() > 1e-6:
            # First there, at rest.
            reach, ways = blend()
            rows = [np.outer(way, q[0] - here) for way in ways]
            client.go(trajectory(joints.names, reach, here + rows[0], *rows[1:]))
        states, _ = client.go(trajectory(joints.names, times, q, qd, qdd))
    except (TimeoutError, RuntimeError) as error:
        print(f"failed: {error}", file=sys.stderr)
        return 1
    finally:
        client.destroy_node()
        rclpy.try_shutdown()
    slowest = v[len(v) // 10 : -len(v) // 10].min()
    print(
        f"{times[-1]:.2f} s, feed {1e3 * slowest:.0f} to {1e3 * v.max():.0f} mm/s, "
        f"deflection at most {1e6 * bent.max():.1f} um of {1e6 * options.tolerance:g}, "
        f"{len(states)} joint states"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
