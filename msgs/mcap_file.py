"""An MCAP file that stays readable up to its last flush, even if the program crashes."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import io
import os
import struct
import zlib
from pathlib import Path
from typing import BinaryIO, NamedTuple

from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Chunk, DataEnd, Footer, Header
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

from msgs.definitions import definition

_RECORD_HEAD = struct.Struct("<BQ")
_PROFILE = "ros2"
CHANNELS_MAX = 4096  # the format numbers them with 16 bits; more publishers are forged ones


class Publisher(NamedTuple):
    """Who published a sample, as the metadata of its channel tells."""

    zenoh_session: str  # its id; empty: unknown
    gid: str  # of the publisher of this topic, hexadecimal


class McapFile:
    """A file being written; every method may raise OSError. Not compressed: CDR floats hardly compress."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._stream = _Stream(path)
        self._writer = Writer(self._stream, compression=CompressionType.NONE)  # type: ignore[arg-type]
        self._schemas: dict[str, int] = {}
        self._channels: dict[tuple[str, Publisher | None], int] = {}
        try:
            self._writer.start(profile=_PROFILE, library="uavpose")
        except OSError:
            self.abandon()
            raise

    @property
    def size(self) -> int:
        """Bytes in the file, without the chunk still in memory."""
        return self._stream.tell()

    def write(
        self,
        name: str,
        ros_type: str,
        payload: bytes,
        log_ns: int,
        publish_ns: int,
        publisher: Publisher | None = None,
    ) -> None:
        """Add a CDR payload of the topic `/name`, in a channel for each `publisher`; times are UTC.

        Beyond CHANNELS_MAX channels, further publishers share one."""
        if len(self._channels) >= CHANNELS_MAX and (name, publisher) not in self._channels:
            publisher = None
        channel = self._channels.get((name, publisher))
        if channel is None:
            channel = self._channels[name, publisher] = self._register(name, ros_type, publisher)
        self._writer.add_message(channel, log_ns, payload, publish_ns)

    def flush(self) -> None:
        """Write everything so far to disk as a chunk."""
        self._writer.flush()
        self._stream.sync()

    def close(self) -> None:
        """Write the index and close."""
        try:
            self._writer.finish()
            self._stream.sync()
        finally:
            self._stream.close()

    def abandon(self) -> None:
        """Close after a write error, keeping the complete part. Raises nothing."""
        with contextlib.suppress(OSError):
            self._stream.close()
        with contextlib.suppress(OSError):
            finish_unfinished(self.path)

    def _register(self, name: str, ros_type: str, publisher: Publisher | None) -> int:
        if ros_type not in self._schemas:
            text = definition(ros_type).encode()
            self._schemas[ros_type] = self._writer.register_schema(ros_type, "ros2msg", text)
        metadata = {} if publisher is None else publisher._asdict()
        return self._writer.register_channel(f"/{name}", "cdr", self._schemas[ros_type], metadata)


class _Stream:
    """Unbuffered output for mcap's writer. Unlike with Python's files, a full disk raises in the call that hits it,
    and closing does not try to write again."""

    def __init__(self, path: Path) -> None:
        self._fd = _locked(path)
        self._at = 0

    def write(self, data: bytes) -> int:
        rest = memoryview(data)
        while rest:
            written = os.write(self._fd, rest)
            self._at += written
            rest = rest[written:]
        return len(data)

    def tell(self) -> int:
        return self._at

    def flush(self) -> None:
        """Nothing is buffered."""

    def sync(self) -> None:
        os.fdatasync(self._fd)
        if not os.fstat(self._fd).st_nlink:  # writing succeeds, and everything is gone when it is closed
            raise FileNotFoundError(errno.ENOENT, "its file was removed")

    def close(self) -> None:
        os.close(self._fd)


def _locked(path: Path) -> int:
    """Descriptor of a new file. Its lock tells other recorders that it was not left by a crash."""
    while True:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        except OSError:  # as of a file system without locks: it is tried again and again
            os.close(descriptor)
            path.unlink(missing_ok=True)
            raise
        if os.fstat(descriptor).st_nlink:
            return descriptor
        os.close(descriptor)  # before it was locked, another recorder took it for an empty one and removed it


def is_written(path: Path) -> bool:
    """Whether a recorder is currently writing to it. Raises OSError."""
    with open(path, "rb") as file:
        try:
            # Shared, so that two concurrent checks do not mistake each other for a writer.
            fcntl.flock(file.fileno(), fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False


def finish_unfinished(path: Path) -> bool:
    """Repair a file left unfinished by a crash: cut off the incomplete record and write the footer. Returns whether it
    was unfinished.

    There is no index, so readers scan the whole file. A file being written is left alone, one without any complete
    record is removed. Raises OSError.
    """
    with open(path, "r+b") as file:
        try:
            fcntl.flock(file.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        whole = unfinished_bytes(file)
        if whole is None:
            return False
        if whole > 0:
            ending = RecordBuilder()
            DataEnd(0).write(ending)
            Footer(0, 0, 0).write(ending)
            file.truncate(whole)
            file.seek(whole)
            file.write(ending.end() + MCAP0_MAGIC)
            return True
    path.unlink()
    return True


def unfinished_bytes(file: BinaryIO) -> int | None:
    """Bytes up to the end of the last complete chunk of a file that a crash ended or that is being written; 0 if there
    is not even a header. None: the file is finished. Raises OSError."""
    size = os.fstat(file.fileno()).st_size
    if size > 2 * len(MCAP0_MAGIC):
        file.seek(-len(MCAP0_MAGIC), os.SEEK_END)
        if file.read() == MCAP0_MAGIC:
            return None
    return _whole_bytes(file, size)


def _is_whole(opcode: int, record: bytes) -> bool:
    stream = ReadDataStream(io.BytesIO(record))
    try:
        if opcode == Opcode.HEADER:
            Header.read(stream)
            return True
        chunk = Chunk.read(stream)
    except Exception:  # the reader may raise anything on corrupt bytes
        return False
    # The length check is for zeros: they parse as an empty chunk with a correct checksum.
    return stream.count == len(record) and zlib.crc32(chunk.data) == chunk.uncompressed_crc


def _whole_bytes(file: BinaryIO, size: int) -> int:
    """End of the last complete chunk, or else of the header; 0 without either. After a crash, the file system may have
    left zeros in place of data that was never written."""
    file.seek(0)
    if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
        return 0
    whole, end = 0, len(MCAP0_MAGIC)
    while len(head := file.read(_RECORD_HEAD.size)) == _RECORD_HEAD.size:
        opcode, length = _RECORD_HEAD.unpack(head)
        end += _RECORD_HEAD.size + length
        if opcode not in (Opcode.HEADER, Opcode.CHUNK, Opcode.MESSAGE_INDEX) or end > size:
            break
        if opcode != Opcode.MESSAGE_INDEX:
            if not _is_whole(opcode, file.read(length)):
                break
            whole = end
        file.seek(end)
    return whole
