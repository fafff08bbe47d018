"""Reads samples from MCAP recordings, in the order of recording, as if they were received live."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path

from mcap.exceptions import McapError
from mcap.reader import make_reader

from msgs import topics
from msgs.ground.errors import InputError
from msgs.ground.feed import Incoming

# Recordings contain no attachments: everything gets one publisher, with sequence numbers continuing across files.
_GID, _numbers = bytes(16), count(1)
_TIME_MAX_NS = 2**63 - 1  # largest time of numpy and Rerun; MCAP's times are unsigned


def check_opens(path: Path) -> None:
    """Raise InputError if `path` is missing or does not start like a recording."""
    with _blame(path), path.open("rb") as stream:
        make_reader(stream).get_header()


def samples(path: Path) -> Iterator[tuple[Incoming, int]]:
    """Each sample of our topics with its recording time (UTC ns); other topics are skipped.

    Raises InputError if the file cannot be read, is damaged or truncated, after yielding the samples before that.
    """
    with _blame(path), path.open("rb") as stream:
        for _, channel, message in make_reader(stream).iter_messages():
            key = f"0{channel.topic}"
            row = topics.parse_any_key(key)
            if row is None:
                continue
            if message.log_time > _TIME_MAX_NS:
                raise ValueError("recorded after the year 2262")
            attachment = topics.attachment(next(_numbers), message.publish_time, _GID)
            yield Incoming(*row, key, message.data, attachment), message.log_time


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
