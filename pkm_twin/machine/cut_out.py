# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Cut a linkage out of a larger robot: what lies between a base and a platform, and its loops.

Links that fixed joints hold together are one body. A joint belongs to the linkage if it is on a
circle of joints and loop closures through the platform and the base, that is in their block of the
graph: no single body separates it from them. Leaving out each body in turn finds the block.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

from pkm_twin.errors import ParameterError
from pkm_twin.machine.graph import group_connected
from pkm_twin.machine.loop_tree import Joint, Link, LoopTree, order_from_root
from pkm_twin.machine.urdf_xml import free_name

MAX_NAMES: Final = 6
"""Most links that a note or an error lists."""


@dataclass(frozen=True, eq=False)
class CutOut:
    """A linkage with its base as the root, notes on what is left out, and what it carries.

    ``carried``: links beyond the platform, kept as its payload.
    """

    tree: LoopTree
    notes: tuple[str, ...]
    carried: tuple[Link, ...]


def find_loop_joints(pairs: Mapping[str, tuple[str, str]], base: str, platform: str) -> dict[str, tuple[str, str]]:
    """Find the joints that are on a path or loop through base and platform, in their order.

    :param pairs: bodies of each joint and closure; no joint has the same body at both ends.
    """
    every = [*pairs.values(), (base, platform)]
    degree = Counter(body for pair in every for body in pair)
    found = dict(pairs)
    for gone in [body for body, count in degree.items() if count > 1]:
        parts = group_connected([body for body in degree if body != gone], every)
        own = next(part for part in parts if {base, platform} - {gone} <= set(part))
        found = {name: pair for name, pair in found.items() if set(pair) - {gone} <= set(own)}
    return found


def cut_out(tree: LoopTree, base: str, platform: str, *, carry: bool = False) -> CutOut:
    """Cut out what is between two links, or in a loop with it.

    :param carry: whether what hangs on moving bodies stays, fixed as drawn: on the platform as its
        payload, on another body as a part of it.
    :raises ParameterError: links that no joints connect, or that cannot move to each other.
    """
    fixed = [joint for joint in tree.joints.values() if joint.kind == "fixed"]
    bodies = {
        link: part[0]
        for part in group_connected(tree.links, [(joint.inner, joint.outer) for joint in fixed])
        for link in part
    }
    ground, tool = bodies[base], bodies[platform]
    if ground == tool:
        raise ParameterError("platform", platform, f"a link that moves relative to base {base!r}")
    joints = [joint for joint in tree.joints.values() if joint.kind != "free"]
    pairs = {j.name: (bodies[j.inner], bodies[j.outer]) for j in (*joints, *tree.closures)}
    pairs = {name: pair for name, pair in pairs.items() if pair[0] != pair[1]}
    part = next(part for part in group_connected(dict.fromkeys(bodies.values()), pairs.values()) if tool in part)
    if ground not in part:
        near = [link for link in tree.links if bodies[link] in part and link != platform]
        raise ParameterError(
            "base", base, f"a link that joints connect to platform {platform!r}, as {', '.join(near[:MAX_NAMES])}"
        )
    circles = find_loop_joints(pairs, ground, tool)
    kept = {body for pair in circles.values() for body in pair}
    links = {name: link for name, link in tree.links.items() if bodies[name] in kept}
    spanned = {
        name: joint
        for name, joint in tree.joints.items()
        if name in circles or (joint.kind == "fixed" and joint.inner in links)
    }
    notes, carried = list[str](), list[Link]()
    bridges = [pair for name, pair in pairs.items() if name not in circles]
    for host in kept:
        # Links that hang on a body are connected to it by joints outside the linkage.
        away = [body for body in dict.fromkeys(bodies.values()) if body not in kept or body == host]
        hanging = next(group for group in group_connected(away, bridges) if host in group)
        own = [link for name, link in tree.links.items() if bodies[name] in hanging and bodies[name] != host]
        if not own:
            continue
        names = ", ".join(link.name for link in own[:MAX_NAMES])
        names += f" and {len(own) - MAX_NAMES} more" if len(own) > MAX_NAMES else ""
        what = f"{names}, {sum(link.mass for link in own):.4g} kg, on {host}"
        if host == ground:
            notes.append(f"left out, on the base: {what}")
        elif not carry:
            way = "its payload" if host == tool else "a part of it"
            notes.append(f"left out, though it moves: {what}; --carry makes it {way}")
        elif host == tool:
            notes.append(f"carried as payload, fixed as drawn: {what}")
            carried += own
        else:
            notes.append(f"carried, fixed as drawn: {what}")
            links |= {link.name: link for link in own}
            for link in own:
                label = free_name(f"{link.name}_carried", {*tree.joints, *spanned})
                frames = link.frame, link.frame
                spanned[label] = Joint(label, "fixed", host, link.name, frames)
    motors = [name for name in tree.actuated if name not in circles]
    if motors:
        notes.append(f"left out, with their motors: {', '.join(motors)}")
    reached = {base, *(one.child for one in order_from_root(base, spanned.values()))}
    for name in links:
        # Loop closures alone hold this body; a free joint places it.
        if name not in reached:
            label = free_name(f"{name}_free", {*tree.joints, *spanned})
            frame = links[name].frame
            spanned[label] = Joint(label, "free", base, name, (frame, frame))
            reached |= {name, *(one.child for one in order_from_root(name, spanned.values()))}
    closures = tuple(joint for joint in tree.closures if joint.name in circles)
    actuated = tuple(name for name in tree.actuated if name in circles)
    made = replace(tree, root=base, links=links, joints=spanned, closures=closures, actuated=actuated)
    return CutOut(made, tuple(notes), tuple(carried))
