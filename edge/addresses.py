"""Addresses as they may be told: without what only their owner should know."""

from __future__ import annotations

import re

_USER_INFO = re.compile(r'//[^/\s"]*@')  # up to the last @ of the authority: a password may hold some
_SECRET_OF_QUERY = re.compile(r'([?&][^=&\s"]*(?:user|usr|pass|pwd|token|key|secret|auth)[^=&\s"]*=)[^&\s"#]*', re.I)


def no_password(text: str) -> str:
    """The text without users and passwords in its addresses: before the host, or in a query under such a name."""
    return _SECRET_OF_QUERY.sub(r"\1***", _USER_INFO.sub("//***@", text))
