"""The key file of MAVLink signing."""

from __future__ import annotations

import os
import secrets
import stat
from pathlib import Path

from edge.errors import InputError

KEY_BYTES = 32


def load_key(path: Path) -> bytes:
    """The 32 bytes of a key file. Raises InputError if it is missing, of another length or readable by others."""
    try:
        with path.open("rb") as file:
            mode = os.fstat(file.fileno()).st_mode
            key = file.read(KEY_BYTES + 1)
    except OSError as error:
        raise InputError(f"signing key {path} cannot be read: {error.strerror}") from error
    if mode & (stat.S_IRWXG | stat.S_IRWXO):
        raise InputError(f"signing key {path} is open to group or others; chmod 600 it")
    if len(key) != KEY_BYTES:
        raise InputError(f"signing key {path} does not hold {KEY_BYTES} bytes")
    return key


def write_new_key(path: Path) -> None:
    """Write 32 random bytes to a new file that only its owner can read. Raises InputError; never overwrites."""
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    except FileExistsError as error:
        raise InputError(f"{path} exists; a key is never overwritten") from error
    except OSError as error:
        raise InputError(f"{path} cannot be written: {error.strerror}") from error
    try:
        with os.fdopen(descriptor, "wb") as file:
            os.fchmod(file.fileno(), 0o600)
            file.write(secrets.token_bytes(KEY_BYTES))
    except OSError as error:  # as on a full disk; an empty file left behind would keep the next attempt from writing
        path.unlink(missing_ok=True)
        raise InputError(f"{path} cannot be written: {error.strerror}") from error
