"""MAVLink 2 message signing: outgoing messages are signed, incoming ones accepted only with a valid signature.

signature = first 6 bytes of sha256(key + frame from its magic to its signature's timestamp) (MAVLink guide, "Message
signing"). Timestamps count 10 us since 2015-01-01 UTC and increase in every stream of (link id, system, component).
"""

from __future__ import annotations

import hashlib
import hmac
import logging
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from edge.links.signing_key import KEY_BYTES, load_key
from msgs.mavlink import dialect

log = logging.getLogger(__name__)

SIGNATURE_BYTES = 6
TIMESTAMP_MAX = 2**48 - 1
EPOCH_S = 1_420_070_400  # 2015-01-01 UTC
UNIT_NS = 10_000
NEW_STREAM_BEHIND_MAX = 60 * 100_000  # one minute
HELD_BACK_MAX_NS = 1_500_000_000
RESERVED_AHEAD = 60 * 100_000  # reserved beyond the time by each save of the state; after a crash these are skipped
# Reserved beyond the last one if that is ahead of the time already: by a crash, or as the autopilot's clock is ahead of
# ours. Not a minute: autopilots count on from what they hear, so each crash would take both a minute further, until one
# that starts anew with the right time is rejected.
RESERVED_MIN = 10 * 100_000
# Reserved anew while this much is left: a power cut takes a save of the last five seconds with it, after which ext4
# commits, and the one before it must do.
RESERVED_LEFT = 6 * 100_000
AHEAD_MAX_S = 600.0  # saved timestamp minus clock; beyond it one of the two is wrong


def timestamp_of(utc_ns: int) -> int:
    """Signing timestamp of a UTC time; 0 before 2015."""
    return max((utc_ns - EPOCH_S * 1_000_000_000) // UNIT_NS, 0)


def ahead_of_clock(state_file: Path, utc_ns: int) -> str | None:
    """A sentence if the timestamp stored in a file is far ahead of a UTC time (nanoseconds); else None.

    Whether the clock was wrong then or is wrong now is unknown. In the first case an autopilot with the right time is
    rejected until the clock catches up; in the second, accepting earlier timestamps would let old messages pass.
    """
    stamp = load_state(state_file)
    ahead_s = (stamp * UNIT_NS - utc_ns) / 1e9 + EPOCH_S
    if stamp == 0 or ahead_s <= AHEAD_MAX_S:
        return None
    day = datetime.fromtimestamp(utc_ns / 1e9, UTC).strftime("%Y-%m-%d")
    return f"{state_file} is {ahead_s / 86400.0:.1f} days ahead of this computer's clock ({day})"


class Signing:
    """One key, the timestamps used with it, and those received. Used by one thread.

    `saved` is the last value given to `save`, or 0: no timestamp up to it is used again. `save` is called before a
    timestamp beyond it is used, so that a restart with a wrong clock repeats none; call `rest` at the end.
    """

    def __init__(self, key: bytes, saved: int, save: Callable[[int], None], utc_ns: Callable[[], int]) -> None:
        if len(key) != KEY_BYTES:
            raise ValueError(f"a signing key has {KEY_BYTES} bytes, not {len(key)}")
        self._key = key
        self._last = self._reserved = saved
        self._seen = max(saved - RESERVED_AHEAD, 0)  # not later than the last one used
        self._save = save
        self._utc_ns = utc_ns
        self._streams: dict[tuple[int, int, int], int] = {}
        self._ahead: dict[tuple[int, int, int], tuple[int, int]] = {}  # see outruns: timestamp, and when it arrived

    def next_timestamp(self) -> int:
        """For the next message: the current time, or one more than the last timestamp."""
        now = timestamp_of(self._utc_ns())
        self._last = min(max(self._last + 1, now), TIMESTAMP_MAX)
        if self._last > self._reserved - RESERVED_LEFT and self._reserved < TIMESTAMP_MAX:
            self._reserved = min(max(now + RESERVED_AHEAD, self._last + RESERVED_MIN), TIMESTAMP_MAX)
            self._save(self._reserved)
        return self._last

    def rest(self) -> None:
        """Nothing more is signed: release the reserved timestamps that were not used. Otherwise each start would be a
        minute ahead of the one before, and soon reject an autopilot with the right time."""
        if self._last < self._reserved:
            self._reserved = self._last
            self._save(self._reserved)

    def prepare(self, mav: Any, link_id: int = 0) -> None:
        """Have a pymavlink packer sign its next message with a link id (0..255)."""
        mav.signing.secret_key = self._key
        mav.signing.link_id = link_id
        mav.signing.sign_outgoing = True
        mav.signing.timestamp = self.next_timestamp()

    def refusal(self, message: Any) -> str | None:
        """Why a parsed message is rejected: "unsigned", "signature" or "replay"; None if it is accepted.

        The signature is checked first: messages not signed with our key do not change the state of the streams.
        """
        reason = self.unproven(message)
        if reason is not None:
            return reason
        stream, timestamp = _stamp(message)
        last = self._streams.get(stream)
        now = max(self._seen, timestamp_of(self._utc_ns()))
        if timestamp <= last if last is not None else timestamp < now - NEW_STREAM_BEHIND_MAX:
            return "replay"
        self._streams[stream] = timestamp
        self._seen = max(self._seen, timestamp)
        self._last = max(self._last, timestamp)
        return None

    def outruns(self, message: Any, now_ns: int) -> bool:
        """Whether a message from another address shows that the accepted peer delays its stream: one that came from
        there more than HELD_BACK_MAX_NS before `now_ns` (monotonic) has not arrived from the peer yet.

        Judged by the order of timestamps, not their time: autopilots without a time source only count up.
        """
        if self.unproven(message) is not None:
            return False
        stream, timestamp = _stamp(message)
        last = self._streams.get(stream)
        if last is None or timestamp <= last:
            return False
        ahead = self._ahead.get(stream)
        if ahead is None or ahead[0] <= last:
            ahead = self._ahead[stream] = (timestamp, now_ns)
        return now_ns - ahead[1] > HELD_BACK_MAX_NS

    def unproven(self, message: Any) -> str | None:
        """ "unsigned" or "signature" if a parsed message is not signed with our key, else None. It may be a replay;
        no state is changed."""
        if not message.get_header().incompat_flags & dialect.MAVLINK_IFLAG_SIGNED:
            return "unsigned"
        frame = bytes(message.get_msgbuf())
        expected = hashlib.sha256(self._key + frame[:-SIGNATURE_BYTES]).digest()[:SIGNATURE_BYTES]
        return None if hmac.compare_digest(expected, frame[-SIGNATURE_BYTES:]) else "signature"


def _stamp(message: Any) -> tuple[tuple[int, int, int], int]:
    """Stream and timestamp of a signed message."""
    frame = bytes(message.get_msgbuf())
    stream = (frame[-13], message.get_srcSystem(), message.get_srcComponent())
    return stream, int.from_bytes(frame[-12:-6], "little")


def open_signing(key_file: Path, state_file: Path, utc_ns: Callable[[], int]) -> Signing:
    """Signing with the key in one file and timestamps in another. Raises InputError for an unusable key file."""
    ahead = ahead_of_clock(state_file, utc_ns())
    if ahead is not None:
        log.warning("mavlink: %s: until it is caught up with, an autopilot that stamps earlier is refused", ahead)
    return Signing(load_key(key_file), load_state(state_file), lambda stamp: _save_state(state_file, stamp), utc_ns)


def load_state(path: Path) -> int:
    try:
        stamp = int(path.read_text(encoding="ascii"))
    except FileNotFoundError:
        return 0
    except (OSError, ValueError) as error:
        log.warning("mavlink: signing state %s is of no use: %s", path, error)
        return 0
    return min(max(stamp, 0), TIMESTAMP_MAX)


def _save_state(path: Path, stamp: int) -> None:
    scratch = path.with_name(path.name + ".new")
    try:
        # No fsync: on a slow card it could delay poses, and ext4 writes a file out before renaming it over another.
        scratch.write_text(str(stamp), encoding="ascii")
        scratch.replace(path)
    except OSError as error:
        log.warning("mavlink: signing state %s cannot be saved: %s", path, error.strerror)
