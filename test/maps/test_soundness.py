# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Damaged maps are rejected, whatever bit is another; numbers that cannot be, too."""

import math

import pytest

pytest.importorskip("h5py")

import h5py

from pkm_twin.maps.store import CHECKSUM_ATTRIBUTE, MapError, append_checksum, open_map
from test.support.robots import partly_long

NAMES = partly_long(["modes prru", "workspace delta_cu", "isotropy delta_cu"], "workspace delta_cu")
SEAL = 56
"""Bytes of the checksum and of the mark before it."""


def rejected(path):
    with pytest.raises(MapError) as caught:
        open_map(path)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.fixture
def copy(tmp_path, small_maps):
    """Makes a copy of a map without its checksum, changed by a function of the HDF5 file."""

    def make(name, change, *, sealed):
        path = tmp_path / "a.nc"
        path.write_bytes(small_maps[name].read_bytes()[:-SEAL])
        with h5py.File(path, "r+") as file:
            if not sealed:
                for key in CHECKSUM_ATTRIBUTE:
                    del file.attrs[key]
            change(file)
        if sealed:
            with path.open("r+b") as file:
                append_checksum(file)
        return path

    return make


@pytest.mark.parametrize("name", NAMES)
def test_every_flipped_bit_is_found(name, small_maps, tmp_path, rng):
    whole = small_maps[name].read_bytes()
    size = len(whole)
    ends = [*range(0, 64, 8), *range(size - SEAL, size, 8)]
    for place in [*ends, *rng.integers(0, size, 100)]:
        damaged = bytearray(whole)
        damaged[place] ^= 1 << rng.integers(8)
        (tmp_path / "a.nc").write_bytes(damaged)
        rejected(tmp_path / "a.nc")


@pytest.mark.parametrize("name", NAMES)
def test_a_file_that_ends_early_or_late_is_found(name, small_maps, tmp_path, rng):
    whole = small_maps[name].read_bytes()
    size = len(whole)
    for end in [0, 1, SEAL - 1, SEAL, size - SEAL, size - 1, *rng.integers(0, size, 5)]:
        (tmp_path / "a.nc").write_bytes(whole[:end])
        rejected(tmp_path / "a.nc")
    (tmp_path / "a.nc").write_bytes(whole + b"\0")
    rejected(tmp_path / "a.nc")


@pytest.mark.parametrize("name", NAMES)
def test_fields_are_compressed_and_have_checksums_of_their_own(name, small_maps):
    sweep, path = small_maps.get(name)
    with h5py.File(path) as file:
        for field in sweep.fields:
            assert file[field].compression == "gzip"
            assert file[field].fletcher32


def test_damaged_numbers_are_found_without_the_files_checksum(copy, rng):
    path = copy("workspace delta_cu", lambda _: None, sealed=False)
    open_map(path).close()
    whole = path.read_bytes()
    with h5py.File(path) as file:
        data = file["value"].id
        chunks = [data.get_chunk_info(k) for k in range(data.get_num_chunks())]
    for chunk in chunks[:: max(1, len(chunks) // 10)]:
        damaged = bytearray(whole)
        damaged[chunk.byte_offset + rng.integers(chunk.size)] ^= 1 << rng.integers(8)
        path.write_bytes(damaged)
        rejected(path)


def put(name, place, value):
    def change(file):
        file[name][place] = value

    return change


def reverse(file):
    file["z"][...] = file["z"][...][::-1]


@pytest.mark.parametrize(
    ("name", "change", "named"),
    [
        ("workspace delta_cu", put("x", 3, math.nan), "x"),
        ("workspace delta_cu", put("height", 0, math.inf), "height"),
        ("workspace delta_cu", reverse, "z"),
        ("workspace delta_cu", put("plane_reach", (0, 0, 0, 0), 2), "plane_reach"),
        ("workspace delta_cu", put("value", (8, 8, 8, 1), math.inf), "value"),
        ("workspace delta_cu", put("volume", (), -1.0), "volume"),
        ("workspace delta_cu", put("row_value", (0, 2, 3), math.inf), "row_value"),
        ("strain-energy upr_rpu", put("value", (4, 4, 4, 0), -1.0), "value"),
        ("strain-energy upr_rpu", put("dominant", (0, 0, 0, 0), -2), "dominant"),
        ("strain-energy upr_rpu", put("factor", (0, 0, 0, 0, 0), 1.1), "factor"),
        pytest.param("modes prru", put("line", (0, 1), 28), "line", marks=pytest.mark.long),
        pytest.param("modes prru", put("strain_share", (0, 0), 1.5), "strain_share", marks=pytest.mark.long),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_numbers_that_cannot_be_are_found_in_a_whole_file(copy, name, change, named):
    open_map(copy(name, lambda _: None, sealed=True)).close()
    assert named in rejected(copy(name, change, sealed=True)).split()


def test_large_fields_are_judged_part_by_part(copy, monkeypatch):
    """As the whole is: in each part a number that cannot be is found."""
    monkeypatch.setattr("pkm_twin.maps.store._SLAB_SIZE", 500)
    open_map(copy("workspace delta_cu", lambda _: None, sealed=True)).close()
    for corner in [(0, 0, 0), (16, 16, 15), (8, 16, 0), (3, 9, 15)]:
        change = put("value", (*corner, 1), math.inf)
        assert "value" in rejected(copy("workspace delta_cu", change, sealed=True))


def test_a_map_of_an_earlier_version_is_rejected(copy):
    def older(file):
        del file.attrs["format"]

    for sealed in (True, False):
        assert "earlier version" in rejected(copy("workspace delta_cu", older, sealed=sealed))
