# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Robot files of the tests' own, from text or data, and how they are rejected."""

import copy

import pytest
import yaml

from pkm_twin import load
from pkm_twin.errors import FileError, ParameterError, one_line
from test.support.robots import parameters_of

MISSING = object()


def changed(data, dotted, value):
    """A copy of the parameters with one value set anew, or removed."""
    data = copy.deepcopy(data)
    *sections, key = dotted.split(".")
    place = data
    for name in sections:
        place = place.setdefault(name, {})
    if value is MISSING:
        del place[key]
    else:
        place[key] = value
    return data


@pytest.fixture
def load_text(tmp_path):
    def load_from(text):
        path = tmp_path / "robot.yaml"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return load(path)

    return load_from


@pytest.fixture
def load_data(load_text):
    # The order of a machine's joints is that of the file.
    return lambda data: load_text(yaml.safe_dump(data, sort_keys=False))


def refusal(loader, *arguments):
    with pytest.raises(ParameterError) as caught:
        loader(*arguments)
    error = caught.value
    assert one_line(error.field) in str(error)
    assert isinstance(error, FileError) or error.bound in str(error)
    assert "\n" not in str(error)
    return error


@pytest.fixture
def with_members(load_data):
    """A shipped robot whose members section is replaced."""
    return lambda name, members: load_data(parameters_of(name) | {"members": members})
