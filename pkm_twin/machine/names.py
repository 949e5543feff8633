# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Names of joints in ROS messages and description files: unique, passive ones without spaces."""

from __future__ import annotations

import re
from typing import Final

from pkm_twin.machine.joints import UNIT_VECTORS, Free, Freedom, name_single_freedoms
from pkm_twin.machine.tree import Tree

FREE_BODY: Final = Free.freedoms(UNIT_VECTORS, 0.0)
"""Freedoms of a body that only closures hold."""
FREE_ROD: Final = (Freedom(UNIT_VECTORS[0]), Freedom(UNIT_VECTORS[1]))
"""Freedoms of a rod about its inner end, if it lies along z."""


def plain_name(name: str) -> str:
    """Return a name without spaces, Roman numerals as digits: ``arm I`` becomes ``arm_1``."""
    digits = {"I": 1, "II": 2, "III": 3, "IV": 4, "V": 5, "VI": 6}
    words = re.sub(r" (I{1,3}|IV|VI?)(?![A-Za-z0-9])", lambda found: f"_{digits[found[1]]}", name)
    return re.sub(r"\s", "_", words)


def joint_labels(tree: Tree) -> dict[tuple[str, str], str]:
    """Return the names of all joints, rods and free bodies in messages and description files.

    Actuated joints keep the names of the robot file, because commands have them. Other names are
    plain; an underscore is added where a name, or that of a single turn or slide, is taken.

    :return: by section of a robot file and entry: ``("joints", "elbow III")`` has ``elbow_3``.
    """
    graph = tree.graph
    wanted = {("joints", name): (name, joint.freedoms) for name, joint in graph.joints.items()}
    wanted |= {("rods", name): (name, FREE_ROD) for name in graph.rods}
    for link in tree.links.values():
        if link.joint is None:
            wanted["bodies", link.body] = f"{link.body}_free", FREE_BODY
    labels = {("joints", name): name for name in graph.actuated}
    taken = {single for name in graph.actuated for single in name_single_freedoms(name, graph.joints[name].freedoms)}
    # Names that need no change come first and stay.
    changes = {key: plain_name(name) != name for key, (name, _) in wanted.items()}
    for key in sorted(wanted.keys() - labels.keys(), key=lambda key: (changes[key], key)):
        name, freedoms = wanted[key]
        label = plain_name(name)
        while taken.intersection([label, f"{label}_end", *name_single_freedoms(label, freedoms)]):
            label += "_"
        taken.update([label, f"{label}_end", *name_single_freedoms(label, freedoms)])
        labels[key] = label
    return labels
