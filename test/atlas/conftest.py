# SPDX-License-Identifier: Apache-2.0
import fcntl
import os
import pickle

import numpy as np
import pytest

pytest.importorskip("xarray")
pytest.importorskip("h5netcdf")
pytest.importorskip("h5py")

from pkm_twin.atlas import modes, workspace
from pkm_twin.atlas.isotropy.sweep import isotropy_sweep
from pkm_twin.atlas.modes.sweep import modes_sweep
from pkm_twin.atlas.run import run
from pkm_twin.atlas.store import open_atlas
from pkm_twin.atlas.strain_energy.sweep import strain_energy_sweep
from pkm_twin.atlas.workspace.sweep import workspace_sweep
from test.support.robots import load


def same(one, other):
    """Whether two atlas files hold the same numbers bit for bit, and the same attributes."""
    with open_atlas(one) as a, open_atlas(other) as b:
        assert set(a.variables) == set(b.variables)
        for name in a.variables:
            assert a[name].values.tobytes() == b[name].values.tobytes() or (
                a[name].dtype.kind == "O" and (a[name] == b[name]).all()
            ), name
            assert a[name].attrs == b[name].attrs
        assert a.attrs == b.attrs
    return True


LAYERS = 25
"""Heights of the circles of small atlases."""
WHOLE = "whole"
"""Of as many heights as a command's atlas, in the name of one."""
MAKE = {
    "strain-energy": lambda robot: strain_energy_sweep(robot, "P1"),
    "coarse-energy": lambda robot: strain_energy_sweep(robot, "P1", 4000),
    "isotropy": lambda robot: isotropy_sweep(robot, 8000),
    "workspace": lambda robot: workspace_sweep(robot, 4000),
    "modes": lambda robot: modes_sweep(robot, 60),
}


class Atlases:
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
            kind, robot, *whole = name.split()
            with pytest.MonkeyPatch.context() as patch:
                if whole != [WHOLE]:
                    for module in (workspace.sweep, modes.sweep):
                        patch.setattr(module, "LAYERS", LAYERS)
                sweep = MAKE[kind](load(robot))
                kept.write_bytes(pickle.dumps(sweep))
                return sweep, run(sweep, path, workers=1)


@pytest.fixture(scope="session")
def small_atlases(tmp_path_factory):
    folder = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        folder = folder.parent
    folder /= "atlases"
    folder.mkdir(exist_ok=True)
    return Atlases(folder)


@pytest.fixture(scope="session")
def strain(small_atlases):
    """The default strain-energy atlas under P1: its sweep and its file, computed alone."""
    return small_atlases.get("strain-energy upr_rpu")


def finite(values):
    return values[np.isfinite(values)]
