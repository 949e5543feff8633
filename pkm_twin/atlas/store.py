# SPDX-License-Identifier: Apache-2.0
"""Finished chunks in a folder beside the target, joined into one NetCDF file at the end.

Both are written under another name and renamed, so a stop at any time leaves whole files only.
"""

from __future__ import annotations

import json
import os
import shutil
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np

from pkm_twin.atlas.extras import require
from pkm_twin.atlas.sweep import Chunk, Sweep, Values
from pkm_twin.errors import PkmTwinError

_MARK: Final = "sweep.json"


class AtlasError(PkmTwinError):
    """An atlas, or the chunks of one, that cannot be read or written as asked."""

    def __init__(self, path: Path, what: str) -> None:
        super().__init__(f"{path}: {what}")
        self.path = path


class Parts:
    """The finished chunks of one sweep, in ``<target>.parts``."""

    def __init__(self, out: Path, sweep: Sweep) -> None:
        self.folder = out.with_name(out.name + ".parts")
        self._sweep = sweep
        self._chunks = sweep.chunks()

    def open(self, overwrite: bool = False) -> None:
        """Make the folder, or take up the one that is there.

        :param overwrite: drop what is there if it belongs to another sweep.
        :raises AtlasError: the folder holds chunks of another sweep.
        """
        mark = self.folder / _MARK
        if self.folder.exists():
            try:
                found = json.loads(mark.read_text())["fingerprint"]
            except (OSError, ValueError, KeyError, TypeError):
                found = None
            if found == self._sweep.fingerprint:
                return
            if any(self.folder.iterdir()) and not overwrite:
                raise AtlasError(
                    self.folder,
                    "holds chunks of another sweep; --overwrite drops them",
                )
            shutil.rmtree(self.folder)
        self.folder.mkdir(parents=True)
        about = {"fingerprint": self._sweep.fingerprint, **self._sweep.attributes}
        _replace(mark, json.dumps(about, indent=2).encode())

    def pending(self) -> list[int]:
        """Indices of chunks that are not there yet."""
        here = {path.name for path in self.folder.iterdir()}
        return [i for i in range(len(self._chunks)) if self._path(i).name not in here]

    def save(self, index: int, values: Values) -> None:
        """Keep a finished chunk."""
        save_part(self.folder, index, values)

    def __iter__(self) -> Iterator[tuple[Chunk, Values]]:
        """All chunks in the order of the grid."""
        for index, chunk in enumerate(self._chunks):
            try:
                with np.load(self._path(index), allow_pickle=False) as data:
                    values = {name: data[name] for name in data.files}
            except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
                raise AtlasError(self._path(index), f"damaged ({error}); remove it") from None
            yield chunk, values

    def drop(self) -> None:
        """Remove the folder."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def _path(self, index: int) -> Path:
        return _part(self.folder, index)


def save_part(folder: Path, index: int, values: Values) -> None:
    """Keep a finished chunk in a folder."""
    path = _part(folder, index)
    hidden = path.with_suffix(".tmp")
    with hidden.open("wb") as file:
        np.savez(file, **values)  # type: ignore[arg-type]
        file.flush()
        os.fsync(file.fileno())
    os.replace(hidden, path)


def _part(folder: Path, index: int) -> Path:
    return folder / f"{index:08}.npz"


def join(sweep: Sweep, parts: Parts, out: Path) -> None:
    """Write the NetCDF file of a finished sweep, chunk by chunk."""
    h5netcdf = require("h5netcdf", "atlas")
    hidden = out.with_name(out.name + ".tmp")
    with h5netcdf.File(hidden, "w") as file:
        file.dimensions = sweep.sizes
        for key, value in sweep.attributes.items():
            file.attrs[key] = value
        for name, coordinate in sweep.coordinates.items():
            _write(file, name, coordinate.dims, coordinate.values, coordinate.attrs)
        targets = {}
        others = [name for name, c in sweep.coordinates.items() if c.dims != (name,)]
        for name, field in sweep.fields.items():
            fill = np.nan if np.dtype(field.dtype).kind == "f" else None
            target = file.create_variable(name, field.dims, field.dtype, fillvalue=fill)
            target.attrs.update(field.attrs)
            own = [o for o in others if set(sweep.coordinates[o].dims) <= set(field.dims)]
            if own:
                target.attrs["coordinates"] = " ".join(own)
            targets[name] = target

        def written() -> Iterator[Values]:
            for chunk, values in parts:
                for name, target in targets.items():
                    target[chunk.first, chunk.start : chunk.stop] = values[name]
                yield {name: values[name] for name in values if name not in targets}

        for name, result in sweep.summaries(written()).items():
            _write(file, name, result.dims, result.values, result.attrs)
    os.replace(hidden, out)


def _write(file: Any, name: str, dims: tuple[str, ...], values: Any, attrs: Any) -> None:
    array = np.asarray(values)
    if array.dtype.kind == "U":
        h5py = require("h5py", "atlas")
        variable = file.create_variable(name, dims, h5py.string_dtype())
        for index in np.ndindex(array.shape):
            variable[index] = str(array[index])
    else:
        variable = file.create_variable(name, dims, array.dtype)
        variable[...] = array
    variable.attrs.update(attrs)


def open_atlas(path: Path) -> Any:
    """A stored atlas as an ``xarray.Dataset``; large fields are read when they are used.

    :raises AtlasError: no atlas.
    """
    xarray = require("xarray", "atlas")
    require("h5netcdf", "atlas")
    try:
        data = xarray.open_dataset(path, engine="h5netcdf")
    except (OSError, ValueError) as error:
        raise AtlasError(path, f"no NetCDF file ({error})") from None
    if "kind" not in data.attrs or "settings" not in data.attrs:
        data.close()
        raise AtlasError(path, "no atlas: it does not say its kind and settings")
    return data


def _replace(path: Path, data: bytes) -> None:
    hidden = path.with_suffix(".tmp")
    hidden.write_bytes(data)
    os.replace(hidden, path)
