"""Samples of MCAP recordings in the order in which they were recorded, as if they came just then."""

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

# Recordings keep no attachments: all that is read is of one publisher, who counts on from file to file.
_GID, _numbers = bytes(16), count(1)
_TIME_MAX_NS = 2**63 - 1  # of numpy's and Rerun's times; MCAP's go on for as long again


def check_opens(path: Path) -> None:
    """Raise InputError if `path` is not there or does not begin as a recording does."""
    with _blame(path), path.open("rb") as stream:
        make_reader(stream).get_header()


def samples(path: Path) -> Iterator[tuple[Incoming, int]]:
    """Each sample of a topic of ours, and when it was recorded (UTC ns). Others are passed over.

    Raises InputError if the file cannot be read, is damaged or ends in the middle, after what comes before that.
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
    """What goes wrong while `path` is read inside is told as InputError in a sentence that names it."""
    try:
        yield
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    except McapError as error:
        why = str(error) or "it ends early"
        raise InputError(f"{path}: is no whole MCAP file ({why}); `mcap recover` may help") from error
    except Exception as error:  # whatever the reader makes of bytes that are not what they say
        raise InputError(f"{path}: is damaged, not all of it can be read; `mcap recover` may help") from error
