# Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0
"""Saving what is whole of a damaged bag. Imports no ROS."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from pkm_twin.bags.format import FormatError
from pkm_twin.bags.storage import BagFile, find_storage, list_files
from pkm_twin.bags.strict import Check, check_files
from pkm_twin.bags.writer import McapWriter, convert_write_error, reject_existing
from pkm_twin.errors import BagError
from pkm_twin.files import write_atomically


@dataclass(frozen=True)
class RecoverResult:
    """The result of :func:`recover`: saved and lost messages.

    ``bytes_lost`` counts damaged and incomplete records of the source's data section; indexes and
    summary are made again. ``unverified`` messages were whole, but no CRC covered them. ``reason``
    is the first fault found, empty for a sound bag.
    """

    messages: int
    bytes_lost: int
    reason: str
    chunks_lost: int
    unverified: int

    @property
    def lossless(self) -> bool:
        """True if nothing of the source was lost."""
        return not self.reason


def recover(source: str | Path, target: str | Path, *, overwrite: bool = False) -> RecoverResult:
    """Save the intact messages of ``source``, a file or a rosbag2 folder, as a new bag ``target``.

    A message is saved if its chunk is complete and matches its CRC. Messages without a CRC are saved,
    too, and counted as unverified. The target appears when it is complete, as one file without
    compressed messages. Attachments, unknown records and rosbag2's metadata of files are left out.

    :raises BagError: the source is not an MCAP bag or has no intact message, the target exists
        and ``overwrite`` is false, or it cannot be written.
    """
    source, target = Path(source), Path(target)
    reject_existing(target, overwrite)
    files, reason = _find_files(source)
    results = check_files(files)
    losses = (part.left_out if isinstance(part, Check) else str(part) for part in results.values())
    reason = next(filter(None, (reason, *losses)), "")
    checks = {file: check for file, check in results.items() if isinstance(check, Check)}
    found = checks.values()
    for file in files:
        if target.exists() and file.path.exists() and target.samefile(file.path):
            raise BagError("target and source are the same file", path=target, reason="exists")
    try:
        with write_atomically(target) as hidden:
            with hidden.open("xb", buffering=0) as output:
                # An OSError here is one of the target, because errors of the source are converted where it is read.
                profile = next((check.header.profile for check in found), "ros2")
                writer = McapWriter(output, target, 256 * 1024, profile)
                for file, check in checks.items():
                    for title, entries, verified in check.metadata:
                        # Write no CRC for unverified metadata, which it would seem to confirm. Leave out rosbag2's
                        # record, which describes the old files.
                        if title != "rosbag2":
                            writer.put_metadata(title, entries, verified)
                    if check.segments:
                        with file.open() as reader:
                            # Write the messages unpacked: the new bag has no metadata to say
                            # that they are packed.
                            records, numbers = check.records, dict[int, int]()
                            for part in check.segments:
                                for _, message in records.iterate_messages(part.read(reader), part.offset):
                                    with suppress(FormatError):
                                        data = records.unpack_message(message, part.offset, reader.budget)
                                        own = message.channel_id
                                        if own not in numbers:
                                            channel = records.channels[own]
                                            numbers[own] = writer.register(
                                                records.schemas.get(channel.schema_id), channel
                                            )
                                        times = message.publish_time, message.sequence
                                        writer.add_message(numbers[own], message.log_time, data, *times)
                writer.finish()
                os.fsync(output.fileno())
            if not any(check.message_count for check in found):
                text = f"no message can be recovered: {reason or 'there are none in it'}"
                raise BagError(text, path=source, reason="nothing")
            reject_existing(target, overwrite)
    except OSError as error:
        raise convert_write_error(error, target) from error
    parts = [part for check in found for part in check.segments]
    return RecoverResult(
        messages=sum(part.messages.count for part in parts),
        bytes_lost=sum(check.bytes_lost for check in found),
        reason=reason,
        chunks_lost=sum(check.chunks_lost for check in found),
        unverified=sum(part.messages.count for part in parts if not part.has_crc),
    )


def _find_files(source: Path) -> tuple[Sequence[BagFile], str]:
    """Return the files to save, and the fault of the folder's metadata if any."""
    try:
        return find_storage(source).files, ""
    except BagError as error:
        if error.reason not in ("metadata", "io", "folder") or not source.is_dir():
            raise
        found = [BagFile(path) for path in list_files(source)]
        if not found:
            raise
        return found, str(error)
