"""Reads samples from MCAP recordings, in the order of recording, as if they were received live."""

from __future__ import annotations

import mmap
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from typing import BinaryIO

from mcap.exceptions import EndOfFile, McapError
from mcap.reader import NonSeekingReader, make_reader
from mcap.records import Channel, Message, Schema

from msgs import topics
from msgs.ground.errors import InputError
from msgs.ground.feed import Incoming
from msgs.mcap_file import Publisher, unfinished_bytes

# Recordings contain no sequence numbers: these continue across files.
_numbers = count(1)
_TIME_MAX_NS = 2**63 - 1  # largest time of numpy and Rerun; MCAP's times are unsigned


def check_opens(path: Path) -> None:
    """Raise InputError if `path` is missing or does not start like a recording."""
    with _blame(path), path.open("rb") as stream:
        make_reader(stream).get_header()


def is_unfinished(path: Path) -> bool:
    """Whether a crash ended the recording, or it is still being written. Raises InputError if it cannot be read."""
    with _blame(path), path.open("rb") as stream:
        return bool(unfinished_bytes(stream))


def samples(path: Path) -> Iterator[tuple[Incoming, int]]:
    """Each sample of our topics with its recording time (UTC ns); other topics are skipped.

    An unfinished recording is read up to the last second that is complete. Raises InputError if the file cannot be read
    or is damaged, after yielding the samples before that.
    """
    with _blame(path), path.open("rb") as stream:
        for _, channel, message in _messages(stream):
            key = f"0{channel.topic}"
            row = topics.parse_any_key(key)
            if row is None:
                continue
            if message.log_time > _TIME_MAX_NS:
                raise ValueError("recorded after the year 2262")
            sender, gid = _publisher(channel)
            attachment = topics.attachment(next(_numbers), message.publish_time, gid)
            yield Incoming(*row, key, message.data, attachment, sender), message.log_time


def _publisher(channel: Channel) -> tuple[str, bytes]:
    """zenoh session and gid; one for all where the recording does not tell, as those made on board and older ones."""
    told = Publisher("", "")._asdict() | dict(channel.metadata)
    return told["zenoh_session"], bytes.fromhex(told["gid"])


def _messages(stream: BinaryIO) -> Iterator[tuple[Schema | None, Channel, Message]]:
    whole = unfinished_bytes(stream)
    if not whole:
        stream.seek(0)
        reader = make_reader(stream, validate_crcs=True)
        reader.get_header()  # of a file that is too short to end with an index, it says so
        yield from reader.iter_messages()
        return
    with mmap.mmap(stream.fileno(), whole, access=mmap.ACCESS_READ) as part:
        try:
            # Ordering by time would keep all messages in memory; they were written in that order.
            yield from NonSeekingReader(part).iter_messages(log_time_order=False)  # type: ignore[arg-type]
        except EndOfFile:
            return  # there is no footer


@contextmanager
def _blame(path: Path) -> Iterator[None]:
    """Turns errors while reading `path` into InputError with a message that names it."""
    try:
        yield
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    except McapError as error:
        why = str(error) or "it ends early"
        raise InputError(f"{path}: is not a complete MCAP file ({why}); `mcap recover` may help") from error
    except Exception as error:  # the reader may raise anything on corrupt bytes
        raise InputError(f"{path}: is damaged and cannot be read completely; `mcap recover` may help") from error
