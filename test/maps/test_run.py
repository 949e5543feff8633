# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Runs that are stopped, spread and killed give the file of an undisturbed one, bit for bit."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import subprocess
import sys
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from pkm_twin import load, robot_names
from pkm_twin.design.pose_path import PosePath
from pkm_twin.design.sweep import sweep as design_sweep
from pkm_twin.errors import MissingExtraError, PkmTwinError
from pkm_twin.maps import run as running
from pkm_twin.maps.run import ClusterError, compute_on_cluster, run
from pkm_twin.maps.store import MapError, Parts, open_map
from test.maps.conftest import CHUNK, few, same
from test.maps.scale import command
from test.maps.test_commands import environment

pytestmark = pytest.mark.usefixtures("chunks")


@pytest.fixture(scope="module")
def small():
    """A map of few poses."""
    return few(500)


def other(sweep):
    """The map under another wrench."""
    return replace(sweep, cases=(sweep.kind.loaded(sweep.robot, "x", (1.0, 0, 0, 0, 0, 0)),))


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


@pytest.mark.parametrize("name", robot_names())
def test_robots_pass_between_processes(name):
    """Also after they have derived what they keep."""
    robot = load(name)
    home = robot.home()
    robot.singularity(robot.inverse(home))
    copy = pickle.loads(pickle.dumps(robot))
    assert copy.name == robot.name
    assert (copy.inverse(home) == robot.inverse(home)).all()
    assert (copy.home() == home).all()


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


def test_a_sweep_of_a_design_is_computed_on_a_cluster(cluster):
    robot = load("five_bar")
    time, box = np.linspace(0.0, 0.5, 20), {"payload.mass": (0.1, 1.0)}
    q = robot.graph.home + 0.1 * np.sin(6.0 * time)[:, None]
    path = PosePath.of_joints(robot, time, q, np.ones_like(q), q)
    done: list[int] = []
    table, expected = (
        design_sweep(robot, box, path, ["peak-effort"], 600, progress=done.append, **how)
        for how in (
            {"compute": partial(compute_on_cluster, scheduler=cluster.scheduler_address)},
            {},
        )
    )
    assert done[2] == done[-1] == 600 and len(done) == 6
    for name, values in expected.quantities.items():
        np.testing.assert_array_equal(table.quantities[name], values)


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
    monkeypatch.setattr(running, "CONNECT_TIMEOUT", "1s")
    with pytest.raises(ClusterError, match="no Dask scheduler answers"):
        run(strain[0], tmp_path / "a.nc", scheduler="tcp://127.0.0.1:9")
    # Without a certificate.
    with pytest.raises(ClusterError, match="TLS"):
        run(strain[0], tmp_path / "a.nc", scheduler="tls://127.0.0.1:9")


def test_chunks_of_another_sweep_are_refused(small, tmp_path):
    out = tmp_path / "a.nc"
    with pytest.raises(Stop):
        run(small, out, workers=1, progress=stop_after(2))
    another = other(small)
    with pytest.raises(MapError, match="another sweep"):
        run(another, out, workers=1)
    changed = small.robot.changed(gravity=[0.0, 0.0, -1.6])
    with pytest.raises(MapError, match="another sweep"):
        run(replace(small, robot=changed), out, workers=1)
    run(another, out, workers=1, overwrite=True)
    with pytest.raises(MapError, match="exists"):
        run(another, out, workers=1)


def test_a_damaged_chunk_is_named(small, tmp_path):
    sweep, out = small, tmp_path / "a.nc"
    with pytest.raises(Stop):
        run(sweep, out, workers=1, progress=stop_after(2))
    part = next(iter(sorted(Parts(out, sweep).folder.glob("*.npz"))))
    part.write_bytes(part.read_bytes()[:100])
    with pytest.raises(MapError, match="damaged"):
        run(sweep, out, workers=1)
    part.unlink()
    run(sweep, out, workers=1)


def test_typed_errors(tmp_path, strain, monkeypatch):
    sweep, _ = strain
    with pytest.raises(PkmTwinError, match="workers"):
        run(sweep, tmp_path / "a.nc", workers=0)
    (tmp_path / "text.nc").write_text("no map")
    with pytest.raises(MapError):
        open_map(tmp_path / "text.nc")
    with pytest.raises(PkmTwinError, match="not 0"):
        running.evaluate_chunk(sweep, sweep.chunks()[0], "0")
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(MissingExtraError, match=r"\[cluster\]"):
        run(sweep, tmp_path / "b.nc", scheduler="tcp://127.0.0.1:9")
    monkeypatch.setitem(sys.modules, "h5netcdf", None)
    with pytest.raises(MissingExtraError, match=r"\[maps\]"):
        run(sweep, tmp_path / "c.nc")


@pytest.mark.long
def test_memory_is_flat(tmp_path):
    """docs/benchmarks.md: from a million poses to ten, all processes together."""
    (_, small), (_, large) = (command(points, 2, tmp_path / "a.nc") for points in (10**6, 10**7))
    assert large < 1.2 * small
    assert large < 2e9


@pytest.fixture
def held(small, tmp_path):
    """A target that a run of this process works on, half done."""
    sweep, out = small, tmp_path / "held.nc"
    parts = Parts(out, sweep)
    parts.open()
    chunk = sweep.chunks()[0]
    parts.save(0, sweep.evaluate(chunk))
    yield sweep, out, parts
    parts.close()


def test_one_run_at_a_time_works_on_a_map(held):
    """The second names the first, drops nothing, and goes on when the first is gone."""
    sweep, out, parts = held
    for overwrite in (False, True):
        for another in (sweep, other(sweep)):
            with pytest.raises(MapError, match=f"process {os.getpid()} on .* works on this"):
                run(another, out, workers=1, overwrite=overwrite)
    assert 0 not in parts.pending()
    parts.close()
    run(sweep, out, workers=1)
    assert not parts.folder.exists()


def test_the_lock_of_a_killed_process_is_nobodys(small, tmp_path):
    program = (
        "import pickle, sys, time; from pathlib import Path;"
        "from pkm_twin.maps.kind import Kind; from pkm_twin.maps.store import Parts;"
        f"Kind.chunk = {CHUNK};"
        "Parts(Path(sys.argv[1]), pickle.load(sys.stdin.buffer)).open();"
        "print('locked', flush=True); time.sleep(600)"
    )
    out = tmp_path / "a.nc"
    with subprocess.Popen(
        [sys.executable, "-c", program, str(out)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env=environment(),
    ) as process:
        pickle.dump(small, process.stdin)
        process.stdin.flush()
        try:
            assert process.stdout.readline().strip() == b"locked"
            with pytest.raises(MapError, match=f"process {process.pid} on"):
                run(small, out, workers=1)
        finally:
            process.kill()
        process.wait()
        run(small, out, workers=1)


@pytest.mark.parametrize("overwrite", [False, True])
def test_what_no_run_wrote_is_never_dropped(overwrite, small, tmp_path):
    out = tmp_path / "a.nc"
    folder = tmp_path / "a.nc.parts"
    folder.mkdir()
    for name in ("thesis.txt", "00000000.npz"):
        (folder / name).write_text("years of work")
    with pytest.raises(MapError, match=r"'thesis\.txt', which no map wrote"):
        run(small, out, workers=1, overwrite=overwrite)
    assert sorted(path.name for path in folder.iterdir()) == ["00000000.npz", "thesis.txt"]


def test_a_target_that_is_no_file_is_not_replaced(small, tmp_path):
    (tmp_path / "folder.nc").mkdir()
    os.mkfifo(tmp_path / "pipe.nc")
    (tmp_path / "file").write_text("")
    for name in ("folder.nc", "pipe.nc", "file/a.nc", "x" * 300, "/proc/a.nc"):
        with pytest.raises(MapError) as caught:
            run(small, tmp_path / name, workers=1, overwrite=True)
        assert "\n" not in str(caught.value)
        assert len(str(caught.value)) < 400
    for name in ("folder.nc", "pipe.nc", "none.nc"):
        with pytest.raises(MapError):
            open_map(tmp_path / name)


@pytest.mark.long
def test_a_killed_scheduler_is_one_error_and_costs_no_finished_chunk(strain, tmp_path):
    pytest.importorskip("distributed")
    sweep, path = strain
    # Its worker is a thread of the same process, and goes with it.
    program = (
        "import time, distributed; cluster = distributed.LocalCluster("
        "n_workers=1, threads_per_worker=1, processes=False, protocol='tcp', host='127.0.0.1', "
        "dashboard_address=None, silence_logs=50, local_directory=r'%s'); "
        "print(cluster.scheduler_address, flush=True); time.sleep(600)"
    )
    with subprocess.Popen(
        [sys.executable, "-c", program % tmp_path],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        env=environment(),
        text=True,
    ) as scheduler:
        try:
            address = scheduler.stdout.readline().strip()

            def progress(done):
                if done:
                    scheduler.kill()

            with pytest.raises(ClusterError, match="went away") as caught:
                run(sweep, tmp_path / "a.nc", scheduler=address, progress=progress)
            assert "\n" not in str(caught.value)
        finally:
            scheduler.kill()
    assert len(Parts(tmp_path / "a.nc", sweep).pending()) < len(sweep.chunks())
    assert same(path, run(sweep, tmp_path / "a.nc", workers=1))
