# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
import fcntl
import os
import pickle
from importlib.util import find_spec

import pytest

# Not imported: most workers have none of these tests.
if not all(map(find_spec, ("xarray", "h5netcdf", "h5py"))):
    pytest.skip("maps need xarray, h5netcdf and h5py", allow_module_level=True)

from pkm_twin.maps.kind import Kind
from pkm_twin.maps.kinds import KINDS
from pkm_twin.maps.kinds.frequency import Frequency
from pkm_twin.maps.kinds.strain_energy import StrainEnergy
from pkm_twin.maps.run import run
from pkm_twin.maps.store import open_map
from pkm_twin.maps.sweep import plan_map
from test.support.robots import load


def same(one, other):
    """Whether two files hold the same numbers bit for bit, and the same attributes."""
    with open_map(one) as a, open_map(other) as b:
        assert set(a.variables) == set(b.variables)
        for name in a.variables:
            assert a[name].values.tobytes() == b[name].values.tobytes() or (
                a[name].dtype.kind == "O" and (a[name] == b[name]).all()
            ), name
            assert a[name].attrs == b[name].attrs
        assert a.attrs == b.attrs
    return True


POINTS = {"modes": 60, "frequency": 60, "workspace": 4000, "isotropy": 2000, "payload": 600}


def shorten(patch, chunk=Kind.chunk):
    """Maps of a short search for the worst pose and for what planes reach, and of few circles.

    In chunks of so many poses.
    """
    for name, most in {"samples": 256, "population": 16, "rounds": 8}.items():
        patch.setattr(Kind, name, most)
        patch.setattr(Frequency, name, most // 4)
    patch.setattr(Kind, "chunk", chunk)
    patch.setattr("pkm_twin.maps.kinds.workspace.LAYERS", 31)
    patch.setattr("pkm_twin.maps.sweep.GRID_SIDE", 21)


@pytest.fixture
def short(monkeypatch):
    """Maps of a test that does not ask how far the search goes."""
    shorten(monkeypatch)


CHUNK = 100
"""Poses of a chunk of the map ``few``."""


@pytest.fixture
def chunks(monkeypatch):
    """The map ``few`` has many of them."""
    shorten(monkeypatch, CHUNK)


def few(points=2000):
    """A map under a force upwards."""
    return plan_map(load("five_bar"), StrainEnergy(), points)


class Maps:
    """One small file of every kind and robot, by "kind robot", computed when it is asked for.

    Once for all processes of a test run: whoever asks first computes it, the others wait.
    """

    def __init__(self, folder):
        self.folder = folder

    def __getitem__(self, name):
        return self.get(name)[1]

    def get(self, name):
        """The sweep and its file."""
        path = self.folder / f"{name.replace(' ', '_')}.nc"
        kept = path.with_suffix(".sweep")
        with open(path.with_suffix(".lock"), "w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if path.exists():
                return pickle.loads(kept.read_bytes()), path
            kind, robot = name.split()
            with pytest.MonkeyPatch.context() as patch:
                shorten(patch)
                sweep = plan_map(load(robot), KINDS[kind](), POINTS.get(kind, 3000))
                kept.write_bytes(pickle.dumps(sweep))
                return sweep, run(sweep, path, workers=1)


@pytest.fixture(scope="session")
def small_maps(tmp_path_factory):
    folder = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        folder = folder.parent
    folder /= "maps"
    folder.mkdir(exist_ok=True)
    return Maps(folder)


@pytest.fixture(scope="session")
def strain(tmp_path_factory):
    """A strain-energy map of many chunks: its sweep and its file, computed alone."""
    with pytest.MonkeyPatch.context() as patch:
        shorten(patch, CHUNK)
        sweep = few()
        return sweep, run(sweep, tmp_path_factory.mktemp("few") / "strain.nc", workers=1)
