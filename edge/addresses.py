"""Removes credentials from addresses, so that they may be logged and published."""

from __future__ import annotations

import re
from typing import Any

# A password may contain quotes: in a structure, credentials are removed text by text (`no_passwords`), not in its JSON.
_USER_INFO = re.compile(r"//[^/\n]*@")  # up to the last @ of the authority: a password may contain some, and spaces
_SECRET_OF_QUERY = re.compile(r"([?&][^=&\s]*(?:user|usr|pass|pwd|token|key|secret|auth)[^=&\s]*=)[^&\s#]*", re.I)


def no_password(text: str) -> str:
    """The text without users and passwords in its addresses, before the host or as query parameters so named."""
    return _SECRET_OF_QUERY.sub(r"\1***", _USER_INFO.sub("//***@", text))


def no_passwords(tree: Any) -> Any:
    """The same lists and dicts with `no_password` applied to each text in them; keys are unchanged."""
    match tree:
        case str():
            return no_password(tree)
        case list():
            return [no_passwords(one) for one in tree]
        case dict():
            return {key: no_passwords(one) for key, one in tree.items()}
    return tree
