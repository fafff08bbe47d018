"""The error of a link that cannot do what its settings ask for."""

from __future__ import annotations

from edge.errors import InputError


class LinkError(InputError):
    """An endpoint cannot be opened; the text is a whole sentence that names it."""
