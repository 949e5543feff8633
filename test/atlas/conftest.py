# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

pytest.importorskip("xarray")
pytest.importorskip("h5netcdf")
pytest.importorskip("h5py")

from pkm_twin import load
from pkm_twin.atlas.isotropy import isotropy_sweep
from pkm_twin.atlas.modes import modes_sweep
from pkm_twin.atlas.run import run
from pkm_twin.atlas.store import open_atlas
from pkm_twin.atlas.strain_energy import strain_energy_sweep
from pkm_twin.atlas.workspace import workspace_sweep


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


@pytest.fixture(scope="session")
def strain(tmp_path_factory):
    """The default strain-energy atlas under P1: its sweep and its file, computed alone."""
    sweep = strain_energy_sweep(load("upr_rpu"), "P1")
    path = tmp_path_factory.mktemp("strain") / "strain.nc"
    return sweep, run(sweep, path, workers=1)


class SmallAtlases:
    """One small file of every kind and robot, by "kind robot", computed when it is asked for."""

    def __init__(self, folder, strain):
        self.folder = folder
        self.files = {"strain-energy upr_rpu": strain[1]}

    def __getitem__(self, name):
        if name not in self.files:
            kind, robot = name.split()
            make, points = {
                "isotropy": (isotropy_sweep, 8000),
                "workspace": (workspace_sweep, 4000),
                "modes": (modes_sweep, 60),
            }[kind]
            path = self.folder / f"{kind}_{robot}.nc"
            self.files[name] = run(make(load(robot), points), path, workers=1)
        return self.files[name]


@pytest.fixture(scope="session")
def small_atlases(strain, tmp_path_factory):
    return SmallAtlases(tmp_path_factory.mktemp("small"), strain)


def finite(values):
    return values[np.isfinite(values)]
