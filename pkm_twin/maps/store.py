# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Store finished chunks next to the target, and join them into one NetCDF file at the end.

Files are written under a temporary name and renamed, so that a stop at any time leaves complete
files only. One run at a time works in a folder: it holds a lock file that names its owner; the
system releases the lock when the process ends. Only files of a run are removed.

HDF5 protects data only: a flipped bit in its own structures may change a number unnoticed.
Therefore the SHA-256 of the file is appended at its end, which HDF5 ignores.
"""

from __future__ import annotations

import fcntl
import gc
import hashlib
import io
import json
import math
import os
import re
import socket
import sys
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Final

import numpy as np
from numpy.typing import NDArray

from pkm_twin.errors import PkmTwinError, import_extra
from pkm_twin.files import replace_file
from pkm_twin.maps.kind import FORMAT_VERSION, Values

if TYPE_CHECKING:
    from xarray import Dataset

    from pkm_twin.maps.kind import Kind
    from pkm_twin.maps.sweep import Chunk, Map
    from pkm_twin.robot.robot import Robot

_LOCK_FILE: Final = "lock"
_FIELD_FILTERS: Final = {
    "compression": "gzip",
    "compression_opts": 1,
    "shuffle": True,
    "fletcher32": True,
}
"""Storage filters of fields; gzip level 1, because full-precision numbers gain little by more."""
_OWN_NAMES: Final = re.compile(r"sweep\.json|lock|\d{8}\.npz|[\w.]+\.tmp")
"""Names of the files that a run writes into its folder."""
CHECKSUM_ATTRIBUTE: Final = {"checksum": "SHA-256 of all before, in the last 32 bytes"}
"""Attribute of a file that has its checksum at the end."""
_SEAL_MARK: Final = b"\npkm_twin atlas SHA-256\n"
_SEAL_SIZE: Final = len(_SEAL_MARK) + hashlib.sha256().digest_size
_SLAB_SIZE: Final = 1 << 22
"""Approximate number of values of a variable that are checked at once."""


class MapError(PkmTwinError):
    """Report a map, or its chunks, that cannot be read or written."""

    def __init__(self, path: Path, what: str) -> None:
        text = str(path)
        text = text if len(text) <= 200 else f"{text[:120]}...{text[-60:]}"
        super().__init__(f"{text}: {what}")
        self.path = path


def source(data: Dataset) -> Path:
    """Return the file that a map came from, for errors."""
    return Path(str(data.encoding.get("source", "map")))


@contextmanager
def convert_write_errors(path: Path) -> Iterator[None]:
    """Convert errors of the system (a full disk, a missing folder) to errors with the path.

    :param path: named if the system names none.
    :raises MapError: instead of any ``OSError``.
    """
    try:
        yield
    except OSError as error:
        where = Path(os.fsdecode(error.filename)) if error.filename else path
        raise MapError(where, error.strerror or str(error) or type(error).__name__) from None


@contextmanager
def convert_read_errors(path: Path) -> Iterator[None]:
    """Convert any error that a damaged file causes to one error.

    :raises MapError: the file is not a valid map.
    """
    try:
        yield
    except PkmTwinError:
        raise
    except Exception as error:
        raise MapError(path, _describe_damage(error)) from None


class Parts:
    """Manage the finished chunks of one sweep, in ``<target>.parts``."""

    def __init__(self, out: Path, sweep: Map) -> None:
        self.folder = out.with_name(out.name + ".parts")
        self._sweep = sweep
        self._chunks = sweep.chunks()
        self._lock = -1

    def open(self, overwrite: bool = False) -> None:
        """Create the folder, or continue with the existing one, and lock it.

        :param overwrite: remove the chunks of another sweep.
        :raises MapError: another process works there, or the folder contains other files; files
            that no run wrote are never removed.
        """
        if self.folder.exists() and not self.folder.is_dir():
            raise MapError(self.folder, "is not a folder; the chunks need a folder of this name")
        while self._lock < 0:
            self.folder.mkdir(parents=True, exist_ok=True)
            foreign = [name for name in os.listdir(self.folder) if not _OWN_NAMES.fullmatch(name)]
            if foreign:
                raise MapError(self.folder, f"holds {foreign[0]!r}, which no map wrote; move it elsewhere")
            self._lock = self._acquire_lock()
        mark = self.folder / "sweep.json"
        try:
            found = json.loads(mark.read_text())["fingerprint"]
        except (OSError, ValueError, KeyError, TypeError):
            found = None
        if found != self._sweep.fingerprint:
            chunks = [name for name in os.listdir(self.folder) if name != _LOCK_FILE]
            if chunks and not overwrite:
                self.close()
                raise MapError(self.folder, "holds chunks of another sweep; --overwrite drops them")
            for name in chunks:
                (self.folder / name).unlink()
            about = {"fingerprint": self._sweep.fingerprint, **self._sweep.attributes}
            replace_file(mark, json.dumps(about, indent=2).encode())
        # Temporary files of killed runs.
        for path in self.folder.glob("*.tmp"):
            path.unlink(missing_ok=True)

    def _acquire_lock(self) -> int:
        """Return the lock's file descriptor; below 0 if the folder was removed meanwhile.

        :raises MapError: another process holds the lock.
        """
        path = self.folder / _LOCK_FILE
        try:
            lock = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        except FileNotFoundError:
            return -1
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            owner = os.read(lock, 200).decode(errors="replace").strip() or "another process"
            os.close(lock)
            raise MapError(self.folder, f"{owner} works on this map") from None
        with suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(lock), os.stat(path)):
                os.ftruncate(lock, 0)
                os.write(lock, f"process {os.getpid()} on {socket.gethostname()}\n".encode())
                return lock
        os.close(lock)
        return -1

    def close(self) -> None:
        """Release the folder's lock; the chunks stay."""
        if self._lock >= 0:
            os.close(self._lock)
            self._lock = -1

    def pending(self) -> list[int]:
        """Return the indices of missing chunks."""
        here = set(os.listdir(self.folder))
        return [i for i in range(len(self._chunks)) if _part_path(self.folder, i).name not in here]

    def save(self, index: int, values: Values) -> None:
        """Save a finished chunk."""
        save_part(self.folder, index, values)

    def grid(self) -> list[Values]:
        """Return the search starts and counts of the grid's chunks, in the order of the grid."""
        chunks = [k for k, chunk in enumerate(self._chunks) if chunk.plane is None]
        return [self._read(index, ("starts", "counts")) for index in chunks]

    def __iter__(self) -> Iterator[tuple[Chunk, Values]]:
        """Yield all chunks with their values, in order."""
        for index, chunk in enumerate(self._chunks):
            yield chunk, self._read(index)

    def _read(self, index: int, names: Sequence[str] = ()) -> Values:
        path = _part_path(self.folder, index)
        try:
            with np.load(path, allow_pickle=False) as data:
                return {name: data[name] for name in names or data.files}
        except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile) as error:
            raise MapError(path, f"damaged ({error}); remove it") from None

    def drop(self) -> None:
        """Remove the files of runs, and the folder if it is empty then."""
        for name in filter(_OWN_NAMES.fullmatch, os.listdir(self.folder)):
            (self.folder / name).unlink(missing_ok=True)
        self.close()
        with suppress(OSError):
            self.folder.rmdir()


def _part_path(folder: Path, index: int) -> Path:
    return folder / f"{index:08}.npz"


def save_part(folder: Path, index: int, values: Values) -> None:
    """Save a finished chunk in a folder."""
    path = _part_path(folder, index)
    # A worker of a killed run may still write the same chunk.
    hidden = path.with_suffix(f".{os.getpid()}.tmp")
    with convert_write_errors(path):
        try:
            with hidden.open("wb") as file:
                np.savez(file, **values)  # type: ignore[arg-type]
                file.flush()
                os.fsync(file.fileno())
            os.replace(hidden, path)
        except BaseException:
            hidden.unlink(missing_ok=True)
            raise


class _Sink(io.RawIOBase):
    """Provide a file to the HDF5 library that records the system's first error.

    Later writes are discarded: the library does not survive errors while it closes a file.
    """

    def __init__(self, file: BinaryIO) -> None:
        super().__init__()
        self._file = file
        self.error: OSError | None = None

    def readinto(self, buffer: Any) -> int:
        view = memoryview(buffer)
        got = self._file.readinto(view) if self.error is None else 0  # type: ignore[attr-defined]
        view[got:] = bytes(len(view) - got)
        return len(view)

    def write(self, data: Any) -> int:
        view = memoryview(data).cast("B")
        done = 0
        while self.error is None and done < len(view):
            try:
                done += self._file.write(view[done:])
            except OSError as error:
                self.error = error
        return len(view)

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        return self._file.seek(offset, whence)

    def tell(self) -> int:
        return self._file.tell()

    def truncate(self, size: int | None = None) -> int:
        if self.error is None:
            try:
                return self._file.truncate(size)
            except OSError as error:
                self.error = error
        return size or 0


def write_map_file(sweep: Map, parts: Parts, out: Path) -> None:
    """Write the NetCDF file of a finished sweep, chunk by chunk.

    :raises MapError: a damaged chunk.
    :raises OSError: the disk is full, or the target cannot be written.
    """
    hidden = parts.folder / "joined.tmp"
    try:
        with hidden.open("w+b", buffering=0) as file:
            sink = _Sink(file)
            try:
                _write_file(sweep, parts, sink)
            except Exception:
                # Errors that the library raises after an error of the system.
                if sink.error is None:
                    raise
            if sink.error is not None:
                raise sink.error
            append_checksum(file)
            os.fsync(file.fileno())
        os.replace(hidden, out)
    finally:
        hidden.unlink(missing_ok=True)


def _write_file(sweep: Map, parts: Parts, sink: _Sink) -> None:
    h5netcdf = import_extra("h5netcdf", "maps")
    summaries = sweep.summaries(parts.grid())
    with h5netcdf.File(sink, "w") as file:
        file.dimensions = sweep.sizes | {
            dim: size
            for variable in summaries.values()
            for dim, size in zip(variable.dims, variable.values.shape, strict=True)
        }
        for key, value in (sweep.attributes | CHECKSUM_ATTRIBUTE).items():
            file.attrs[key] = value
        for name, small in (sweep.coordinates | summaries).items():
            array = np.asarray(small.values)
            if array.dtype.kind == "U":
                variable = file.create_variable(name, small.dims, import_extra("h5py", "maps").string_dtype())
                for index in np.ndindex(array.shape):
                    variable[index] = str(array[index])
            else:
                filters = {"fletcher32": True} if array.size and array.ndim else {}
                variable = file.create_variable(name, small.dims, array.dtype, **filters)
                variable[...] = array
            variable.attrs.update(_convert_bounds(small.attrs, array.dtype))
        sizes = sweep.sizes
        fields = sweep.fields
        for name, field in fields.items():
            fill = np.nan if np.dtype(field.dtype).kind == "f" else None
            shape = [sizes[dim] for dim in field.dims]
            # Storage chunks are as large as the parts that are written.
            planes = field.dims[0] == "plane"
            rows = (1, *shape[1:3], 1, *shape[4:]) if planes else (sweep.rows, *shape[1:])
            chunks = tuple(min(sides) for sides in zip(rows, shape, strict=True))
            target = file.create_variable(
                name, field.dims, field.dtype, fillvalue=fill, chunks=chunks, **_FIELD_FILTERS
            )
            target.attrs.update(_convert_bounds(field.attrs, field.dtype))
        for chunk, values in parts:
            if sink.error is not None:
                raise sink.error
            for name in values.keys() & fields.keys():
                file[name][chunk.place(fields[name].dims)] = values[name]


def _convert_bounds(attrs: Mapping[str, Any], dtype: Any) -> dict[str, Any]:
    """Convert bounds among the attributes to their variable's type, as CF requires."""
    return {key: np.asarray(value, dtype)[()] if key.startswith("valid_") else value for key, value in attrs.items()}


def _open_dataset(xarray: Any, path: Path) -> Dataset:
    """Open the data set of a file.

    After an error the library's objects raise when they are deleted, which is silenced here.
    """
    hook, sys.unraisablehook = sys.unraisablehook, lambda _: None
    try:
        try:
            data: Dataset = xarray.open_dataset(path, engine="h5netcdf")
        except Exception as error:
            what = _describe_damage(error)
        else:
            return data
        gc.collect()
        raise MapError(path, what)
    finally:
        sys.unraisablehook = hook


def _describe_damage(error: Exception) -> str:
    what = " ".join(str(error).split())[:200]
    return f"no map of `pkm-twin map`, or damaged: {what}"


def open_map(path: Path) -> Dataset:
    """Open a stored map; check its checksum and the ranges of its numbers.

    Large fields are read in parts for the check, and again when they are used.

    :raises MapError: no map, a damaged one, or one with impossible numbers.
    """
    xarray = import_extra("xarray", "maps")
    import_extra("h5netcdf", "maps")
    with convert_write_errors(path):
        if not path.exists():
            raise MapError(path, "no such file")
        if not path.is_file():
            raise MapError(path, "no regular file")
        # Checked before HDF5 opens the file, because damage may crash the process there.
        with path.open("rb") as file:
            size = max(0, file.seek(0, 2) - _SEAL_SIZE)
            file.seek(size)
            sealed, digest = file.read(len(_SEAL_MARK)) == _SEAL_MARK, file.read()
            if sealed and digest != _digest(file, size):
                raise MapError(path, "damaged, or changed by another program: its checksum differs")
    data = _open_dataset(xarray, path)
    try:
        if data.attrs.get("format") != FORMAT_VERSION:
            older = "kind" in data.attrs and "robot" in data.attrs
            what = "made by an earlier version: build it again" if older else "no map"
            raise MapError(path, what)
        if not sealed and CHECKSUM_ATTRIBUTE.keys() <= data.attrs.keys():
            what = "damaged, or written by another program: its checksum is missing"
            raise MapError(path, what)
        with convert_read_errors(path):
            wrong = find_invalid_number(data)
        if wrong:
            raise MapError(path, f"no map of `pkm-twin map`, or damaged: {wrong}")
    except MapError:
        data.close()
        raise
    return data


def append_checksum(file: BinaryIO) -> None:
    """Append the checksum of a whole file at its end."""
    size = file.seek(0, 2)
    digest = _digest(file, size)
    file.seek(size)
    # One write may take less than all.
    rest = memoryview(_SEAL_MARK + digest)
    while rest:
        rest = rest[file.write(rest) :]


def _digest(file: BinaryIO, size: int) -> bytes:
    file.seek(0)
    found = hashlib.sha256()
    while size > 0 and (block := file.read(min(size, (1 << 20)))):
        found.update(block)
        size -= len(block)
    return found.digest()


def find_invalid_number(data: Dataset) -> str:
    """Describe the first invalid number of a map; return an empty text if there is none.

    Axes and other coordinates are finite, axes never decrease, nothing is infinite. All numbers
    are within ``valid_min`` and ``valid_max`` (CF conventions, 2.5.1), or NaN in fields.
    """
    for name, variable in data.variables.items():
        if variable.dtype.kind not in "fiu" or not variable.size:
            continue
        low, high = (
            float(variable.attrs.get(f"valid_{end}", bound)) for end, bound in (("min", -math.inf), ("max", math.inf))
        )
        for values in _iterate_slabs(variable):
            if name in data.coords and np.isnan(values).any():
                return f"{name} has the value nan"
            # The smallest and the largest number; NaN if there is none.
            for value in (np.fmin.reduce(values, None), np.fmax.reduce(values, None)):
                # Numbers are of order 1; a smaller excess is rounding.
                if math.isinf(value) or value < low - 1e-9 or value > high + 1e-9:
                    return f"{name} has the value {value:g}, allowed: {low:g} to {high:g}"
            if variable.dims == (name,) and (np.diff(values) < 0).any():
                return f"the axis {name} decreases"
    return ""


def _iterate_slabs(variable: Any) -> Iterator[NDArray[Any]]:
    """Yield all numbers of a variable, large ones in parts along the first two axes."""
    if variable.size <= _SLAB_SIZE or variable.ndim < 2:
        yield np.asarray(variable.values)
        return
    first, second, *rest = variable.shape
    rows = max(1, _SLAB_SIZE // math.prod(rest))
    for k in range(first):
        for start in range(0, second, rows):
            yield np.asarray(variable[k, start : start + rows].values)


def write_arrays(path: Path, file: Path, kind: Kind, robot: Robot) -> None:
    """Write the poses of a stored map that count, and a kind's arrays of them, as an .npz file.

    ``position``: shape (k, m), by ``names``. ``value``: shape (k, cases), by ``cases``.
    """
    with open_map(file) as data, convert_read_errors(file):
        cases = data["value"].values.reshape(-1, data.sizes["case"])
        if "pose" in data:
            poses = data["pose"].values
        else:
            grid = np.meshgrid(*(data[name].values for name in robot.pose_names), indexing="ij")
            poses = np.stack(grid, -1).reshape(-1, len(grid))
        named = {"names": np.array(robot.pose_names), "cases": data["case"].values.astype("U")}
    counted = np.isfinite(cases).any(-1)
    arrays: dict[str, Any] = named | {"position": poses[counted], "value": cases[counted]}
    memory = io.BytesIO()
    np.savez_compressed(memory, **(arrays | kind.arrays(robot, poses[counted])))
    replace_file(path, memory.getvalue())
