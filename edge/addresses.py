"""Addresses as they may be told: without what only their owner should know."""

from __future__ import annotations

import re

_USER_INFO = re.compile(r'//[^/\s"]*@')  # up to the last @ of the authority: a password may hold some


def no_password(text: str) -> str:
    """The text without the users and passwords before the hosts in it. What a query tells (`?pwd=`) stays."""
    return _USER_INFO.sub("//***@", text)
