"""Addresses as they may be told: without what only their owner should know."""

from __future__ import annotations

import re
from typing import Any

# A quote may be part of a secret: of a structure they are taken out text by text (`no_passwords`), not out of its JSON.
_USER_INFO = re.compile(r"//[^/\n]*@")  # up to the last @ of the authority: a password may hold some, and spaces
_SECRET_OF_QUERY = re.compile(r"([?&][^=&\s]*(?:user|usr|pass|pwd|token|key|secret|auth)[^=&\s]*=)[^&\s#]*", re.I)


def no_password(text: str) -> str:
    """The text without users and passwords in its addresses: before the host, or in a query under such a name."""
    return _SECRET_OF_QUERY.sub(r"\1***", _USER_INFO.sub("//***@", text))


def no_passwords(tree: Any) -> Any:
    """The same lists and dicts with `no_password` of each text in them; keys stay."""
    match tree:
        case str():
            return no_password(tree)
        case list():
            return [no_passwords(one) for one in tree]
        case dict():
            return {key: no_passwords(one) for key, one in tree.items()}
    return tree
