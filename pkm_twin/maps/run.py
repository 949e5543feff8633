# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Compute a sweep in one process, on all cores, or on a Dask cluster.

Chunks are independent, so that the results are bit-identical wherever and in whatever order they
are computed. Few chunks are in flight at a time, and each is saved when it is done: memory use does
not grow with the sweep.
"""

from __future__ import annotations

import functools
import itertools
import logging
import multiprocessing
import os
import pickle
import signal
from asyncio import CancelledError
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError as FutureCancelled
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any, Final, Protocol

import pkm_twin
from pkm_twin.errors import ParameterError, PkmTwinError, import_extra
from pkm_twin.maps.kind import Values
from pkm_twin.maps.store import MapError, Parts, convert_write_errors, save_part, write_map_file
from pkm_twin.maps.sweep import Chunk, Map
from pkm_twin.threads import one_blas_thread_for_children

Progress = Callable[[int], None]
Work = Sequence[tuple[int, Any]]
"""Numbered parts of a task."""

CONNECT_TIMEOUT: Final = "10s"
"""Time in which a scheduler must answer."""


class Task(Protocol):
    """Define work that workers receive with each of its parts, as :class:`Map` with its chunks."""

    @property
    def fingerprint(self) -> str:
        """Identifier of this task."""

    def evaluate(self, chunk: Any, /) -> Values:
        """Compute one part."""


class ClusterError(PkmTwinError):
    """Report a Dask scheduler that does not answer, or a cluster that keeps losing workers."""


def run(
    sweep: Map,
    out: Path,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Path:
    """Compute a sweep into a NetCDF file; reuse finished chunks of a stopped run.

    :param workers: processes on this machine; default one per core, 1 is this process alone.
    :param scheduler: address of a Dask scheduler, which then does the work.
    :param overwrite: replace the target, and chunks of another sweep.
    :param progress: called with the number of points done.
    :raises MapError: the target exists, another process works on it, the kept chunks belong to
        another sweep, or the system refuses to write.
    :raises ClusterError: no scheduler, or workers that keep dying.
    :raises MissingExtraError: a package that is not installed.
    """
    # Check before hours of work.
    import_extra("h5netcdf", "maps")
    if workers is not None and workers < 1:
        raise PkmTwinError(f"workers is {workers}; it has to be 1 or more")
    with convert_write_errors(out):
        if out.exists() and not overwrite:
            raise MapError(out, "exists; give --overwrite to replace it")
        if out.exists() and not out.is_file():
            raise MapError(out, "is not a regular file, so it is not replaced")
        parts = Parts(out, sweep)
        parts.open(overwrite)
        try:
            tell = progress or (lambda _: None)
            _compute_pending(sweep, parts, False, workers, scheduler, tell)
            # Deterministic, so that a run that is resumed has the same planes.
            try:
                sweep = sweep.with_worst(parts.grid())
            except ParameterError:
                # No pose counts, so the chunks are useless.
                parts.drop()
                raise
            _compute_pending(sweep, parts, True, workers, scheduler, tell)
            write_map_file(sweep, parts, out)
            parts.drop()
        finally:
            parts.close()
    return out


def _compute_pending(
    sweep: Map,
    parts: Parts,
    planes: bool,
    workers: int | None,
    scheduler: str | None,
    tell: Progress,
) -> None:
    """Compute the missing chunks of the grid or of the planes."""
    chunks = sweep.chunks()
    pending = parts.pending()
    done = sum(map(sweep.count, chunks)) - sum(sweep.count(chunks[i]) for i in pending)
    tell(done)
    work = [(i, chunks[i]) for i in pending if (chunks[i].plane is not None) == planes]
    results: Iterator[tuple[int, Values | None]]
    if scheduler is not None and work:
        results = compute_on_cluster(sweep, work, scheduler)
    else:
        count = workers or os.cpu_count() or 1
        # Starting processes takes longer than a few chunks.
        alone = count == 1 or len(work) <= 3
        results = compute_serially(sweep, work) if alone else compute_on_cores(sweep, work, count, parts.folder)
    for index, values in results:
        if values is not None:
            parts.save(index, values)
        done += sweep.count(chunks[index])
        tell(done)


def compute_serially(sweep: Map, work: Work) -> Iterator[tuple[int, Values]]:
    """Compute chunks one after the other in this process."""
    for index, chunk in work:
        yield index, sweep.evaluate(chunk)


def compute_on_cores(sweep: Map, work: Work, workers: int, folder: Path) -> Iterator[tuple[int, Values | None]]:
    """Compute chunks on processes of this machine, in the order of completion.

    The processes save their chunks themselves (None here): only a number goes through the pipe,
    which a process killed during a long message would block. A killed process costs its chunk's
    time.

    :raises ClusterError: processes died three times.
    """
    # The first chunk compiles what the others load; processes that all compile would waste it.
    first = next((k for k, (_, chunk) in enumerate(work) if sweep.count(chunk)), 0)
    yield from compute_serially(sweep, [work[first]])
    rest = dict([*work[:first], *work[first + 1 :]])
    # Pickled here once: a pool that fails to pickle its work would wait forever.
    packed, broken = pickle.dumps(sweep), 0
    while rest:
        # Not forked: the parent has threads (the progress bar's).
        context = multiprocessing.get_context("spawn")
        pool = ProcessPoolExecutor(min(workers, len(rest)), mp_context=context)
        try:
            # A terminal sends Ctrl-C to all its processes; the parent alone handles it.
            signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
            try:
                with one_blas_thread_for_children():
                    futures = [pool.submit(_evaluate_and_save, packed, c, folder, k) for k, c in rest.items()]
            finally:
                signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
            for future in as_completed(futures):
                index = future.result()
                del rest[index]
                yield index, None
        except BrokenProcessPool:
            broken += 1
            if broken == 3:
                raise ClusterError("processes died 3 times in this sweep") from None
        finally:
            pool.shutdown(cancel_futures=True)


def compute_on_cluster(sweep: Task, work: Work, scheduler: str) -> Iterator[tuple[int, Values]]:
    """Compute chunks on a Dask cluster, in the order of completion.

    The scheduler gives the chunks of a lost worker to another one.

    :raises ClusterError: no scheduler answers, it has no workers, or chunks keep losing theirs.
    """
    distributed = import_extra("distributed", "cluster")
    # Its log is long; one line of ours reports the error.
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    arguments = distributed.Security().get_connection_args("client")
    if scheduler.startswith("tls:") and arguments.get("ssl_context") is None:
        # A client without a certificate fails at once, and again when it is closed.
        raise ClusterError(f"{scheduler} asks for TLS, and Dask is configured with no certificate")
    try:
        client = distributed.Client(scheduler, timeout=CONNECT_TIMEOUT, set_as_default=False)
    except (OSError, TimeoutError, ValueError, RuntimeError) as error:
        raise ClusterError(f"no Dask scheduler answers at {scheduler}: {error}") from None

    def submit(index: int, chunk: Any) -> Any:
        key = f"map-{sweep.fingerprint[:16]}-{index}"
        return client.submit(evaluate_chunk, sweep, chunk, pkm_twin.__version__, key=key, pure=False)

    with client:
        threads = sum(client.nthreads().values())
        if not threads:
            raise ClusterError(f"the Dask scheduler at {scheduler} has no workers")
        try:
            # Two chunks per thread in flight; results are not kept.
            queue = itertools.starmap(submit, work)
            finished = distributed.as_completed(list(itertools.islice(queue, 2 * threads)), loop=client.loop)
            for future in finished:
                values, index = future.result(), int(future.key.rpartition("-")[2])
                del future
                yield index, values
                for following in itertools.islice(queue, 1):
                    finished.add(following)
        except distributed.KilledWorker as error:
            raise ClusterError(f"workers kept dying: {error}") from None
        except (CancelledError, FutureCancelled, distributed.comm.CommClosedError):
            raise ClusterError(f"the Dask scheduler at {scheduler} went away") from None
        except PkmTwinError:
            raise
        except OSError as error:
            raise ClusterError(f"the Dask scheduler at {scheduler}: {error}") from None


def evaluate_chunk(sweep: Task, chunk: Any, version: str) -> Values:
    """Compute one chunk in a worker.

    :raises PkmTwinError: what the chunk raises, in a form that passes between processes; or a
        worker with another version of this package.
    """
    if pkm_twin.__version__ != version:
        raise PkmTwinError(f"a worker has pkm_twin {pkm_twin.__version__}, not {version}")
    try:
        return sweep.evaluate(chunk)
    except PkmTwinError as error:
        raise PkmTwinError(str(error)) from None


def _evaluate_and_save(packed: bytes, chunk: Chunk, folder: Path, index: int) -> int:
    save_part(folder, index, evaluate_chunk(_unpickle(packed), chunk, pkm_twin.__version__))
    return index


@functools.lru_cache(1)
def _unpickle(packed: bytes) -> Map:
    # Once per process, so that the robot's caches serve all chunks.
    sweep: Map = pickle.loads(packed)  # noqa: S301  from the parent
    return sweep
