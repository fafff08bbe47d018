"""Files that appear under their name only when they are complete."""

from __future__ import annotations

import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def unfinished(path: Path) -> Iterator[Path]:
    """A temporary file's path beside `path`, to be written in the block, at whose end it replaces `path`; if the block
    raises, `path` is unchanged. Raises OSError.

    No other process uses the same one, nor does one in another container with the same folder: of two that write a
    file at the same time, each writes a whole one, and the later one is kept.
    """
    part = path.with_name(f"{path.name}.{secrets.token_hex(4)}.part")
    try:
        yield part
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
