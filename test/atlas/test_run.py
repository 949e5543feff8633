# SPDX-License-Identifier: Apache-2.0
"""Runs that are stopped, spread and killed give the file of an undisturbed one, bit for bit."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys

import pytest

from pkm_twin import load
from pkm_twin.atlas import run as running
from pkm_twin.atlas.extras import MissingExtraError
from pkm_twin.atlas.isotropy import isotropy_sweep
from pkm_twin.atlas.run import ClusterError, run
from pkm_twin.atlas.store import AtlasError, Parts, open_atlas
from pkm_twin.atlas.strain_energy import strain_energy_sweep
from pkm_twin.errors import PkmTwinError
from test.atlas.conftest import same
from test.atlas.scale import command


class Stop(Exception):
    pass


def stop_after(calls):
    """A progress function that stops the run at its n-th call."""
    count = 0

    def progress(_):
        nonlocal count
        count += 1
        if count > calls:
            raise Stop

    return progress


def test_a_resumed_run_is_an_uninterrupted_one(strain, tmp_path):
    sweep, path = strain
    out = tmp_path / "strain.nc"
    for calls in (0, 3, 4):
        with pytest.raises(Stop):
            run(sweep, out, workers=1, progress=stop_after(calls))
        assert not out.exists()
    assert len(Parts(out, sweep).pending()) == len(sweep.chunks()) - 7
    seen = []
    run(sweep, out, workers=1, progress=seen.append)
    assert seen[0] > 0
    assert seen[-1] == sweep.points
    assert same(path, out)
    assert out.read_bytes() == path.read_bytes()
    assert not Parts(out, sweep).folder.exists()


def test_processes_are_one_process(strain, tmp_path):
    sweep, path = strain
    assert same(path, run(sweep, tmp_path / "a.nc", workers=2))


def test_a_killed_process_costs_time_not_results(strain, tmp_path):
    sweep, path = strain
    killed = []

    def progress(_):
        children = multiprocessing.active_children()
        if children and not killed:
            killed.append(children[0].pid)
            os.kill(children[0].pid, signal.SIGKILL)

    assert same(path, run(sweep, tmp_path / "a.nc", workers=2, progress=progress))
    assert killed


def test_isotropy_on_processes(small_atlases, tmp_path):
    sweep = isotropy_sweep(load("prru"), 8000)
    out = run(sweep, tmp_path / "a.nc", workers=2)
    assert same(small_atlases["isotropy prru"], out)


@pytest.fixture(scope="module")
def cluster():
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        processes=True,
        host="127.0.0.1",
        dashboard_address=None,
        silence_logs=50,
    ) as made:
        made.wait_for_workers(2)
        yield made


def test_a_cluster_is_one_process(strain, tmp_path, cluster):
    sweep, path = strain
    out = run(sweep, tmp_path / "a.nc", scheduler=cluster.scheduler_address)
    assert same(path, out)


def test_a_killed_worker_costs_time_not_results(strain, tmp_path, cluster):
    distributed = pytest.importorskip("distributed")
    sweep, path = strain
    with distributed.Client(cluster.scheduler_address, set_as_default=False) as client:
        pids = sorted(client.run(os.getpid).values())
    killed = []

    def progress(done):
        if done and not killed:
            killed.append(pids[0])
            os.kill(pids[0], signal.SIGKILL)

    out = run(sweep, tmp_path / "a.nc", scheduler=cluster.scheduler_address, progress=progress)
    assert killed
    assert same(path, out)


def test_a_stopped_run_on_a_cluster_is_resumed_here(strain, tmp_path, cluster):
    sweep, path = strain
    out = tmp_path / "a.nc"
    with pytest.raises(Stop):
        run(sweep, out, scheduler=cluster.scheduler_address, progress=stop_after(2))
    assert same(path, run(sweep, out, workers=1))


def test_no_scheduler(strain, tmp_path, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr(running, "CONNECT", "1s")
    with pytest.raises(ClusterError, match="no Dask scheduler answers"):
        run(strain[0], tmp_path / "a.nc", scheduler="tcp://127.0.0.1:9")


def test_chunks_of_another_sweep_are_refused(tmp_path):
    out = tmp_path / "a.nc"
    robot = load("upr_rpu")
    with pytest.raises(Stop):
        run(strain_energy_sweep(robot, "P1", 1000), out, workers=1, progress=stop_after(2))
    other = strain_energy_sweep(robot, "P2", 1000)
    with pytest.raises(AtlasError, match="another sweep"):
        run(other, out, workers=1)
    changed = robot.changed(members={"shear_factor": 1.1})
    with pytest.raises(AtlasError, match="another sweep"):
        run(strain_energy_sweep(changed, "P1", 1000), out, workers=1)
    run(other, out, workers=1, overwrite=True)
    with pytest.raises(AtlasError, match="exists"):
        run(other, out, workers=1)


def test_a_damaged_chunk_is_named(tmp_path):
    sweep = strain_energy_sweep(load("upr_rpu"), "P1", 1000)
    out = tmp_path / "a.nc"
    with pytest.raises(Stop):
        run(sweep, out, workers=1, progress=stop_after(2))
    part = next(iter(sorted(Parts(out, sweep).folder.glob("*.npz"))))
    part.write_bytes(part.read_bytes()[:100])
    with pytest.raises(AtlasError, match="damaged"):
        run(sweep, out, workers=1)
    part.unlink()
    run(sweep, out, workers=1)


def test_typed_errors(tmp_path, strain, monkeypatch):
    sweep, _ = strain
    with pytest.raises(PkmTwinError, match="workers"):
        run(sweep, tmp_path / "a.nc", workers=0)
    (tmp_path / "text.nc").write_text("no atlas")
    with pytest.raises(AtlasError):
        open_atlas(tmp_path / "text.nc")
    with pytest.raises(PkmTwinError, match="not 0"):
        running.compute(sweep, sweep.chunks()[0], "0")
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(MissingExtraError, match=r"pkm_twin\[cluster\]"):
        run(sweep, tmp_path / "b.nc", scheduler="tcp://127.0.0.1:9")
    monkeypatch.setitem(sys.modules, "h5netcdf", None)
    with pytest.raises(MissingExtraError, match=r"pkm_twin\[atlas\]"):
        run(sweep, tmp_path / "c.nc")


@pytest.mark.long
def test_memory_is_flat(tmp_path):
    """docs/scale.md: from a million poses to ten, all processes together."""
    (seconds, small), (_, large) = (
        command(points, 2, tmp_path / "a.nc") for points in (10**6, 10**7)
    )
    assert seconds < 30.0
    assert large < 1.2 * small
    assert large < 2e9
