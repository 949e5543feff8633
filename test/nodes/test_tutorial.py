# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""The tutorial for ROS, from its first line to its last, in a shell with the wheels' commands."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from test.docs.test_docs import DOCS, blocks
from test.support.pages import assert_output

PATIENCE = 240.0
MARK = "---- end of a block ----"


@pytest.mark.long
def test_its_blocks_print_what_it_says(domain, tmp_path):
    for name in ("bags", "examples"):
        (tmp_path / name).symlink_to(DOCS.parent / name)
    script, expected = [], []
    for language, block, name in blocks("tutorial_ros.md"):
        if name:
            (tmp_path / name).write_text(block)
        elif language == "bash":
            script += [block, f"echo '{MARK}'"]
        else:
            expected.append(block)
    environment = domain.environment()
    folder = Path(sys.executable).parent
    environment["PATH"] = os.pathsep.join([str(folder), environment["PATH"]])
    found = subprocess.run(
        ["timeout", str(PATIENCE), "bash", "-c", "\n".join(script)],
        stdout=subprocess.PIPE,
        text=True,
        cwd=tmp_path,
        env=environment,
        check=True,
    ).stdout.split(MARK)
    for block, output in zip(expected, found[:-1], strict=True):
        assert_output(block, output)
