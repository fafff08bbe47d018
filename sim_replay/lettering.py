"""Names that users chose, drawn in figures as they are: in any script that an installed font has."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

from matplotlib.font_manager import fontManager
from matplotlib.ft2font import FT2Font

FAMILY = "DejaVu Sans"  # comes with matplotlib
_NO_LETTERS = "Last Resort"  # this font has one box for all characters of a script


def lettering(texts: Sequence[str]) -> tuple[list[str], dict[str, Any]]:
    """The texts, and the keywords for matplotlib to draw them with.

    A character that no installed font has is written as its escape sequence: boxes would make different names alike.
    Dollar signs stay dollar signs, and begin no formula.
    """
    families, escapes = [FAMILY], {}
    for character in sorted(set("".join(texts)) - {"\n"}):
        family = _family_with(character, tuple(families))
        if family is None:
            escapes[ord(character)] = character.encode("unicode_escape").decode()
        elif family not in families:
            families.append(family)
    return [text.translate(escapes) for text in texts], {"family": families, "parse_math": False}


def _family_with(character: str, preferred: Sequence[str]) -> str | None:
    """An installed font family that has the character; after the preferred ones, one without serifs if possible."""
    others = sorted(_upright_fonts().keys() - set(preferred), key=lambda name: ("Sans" not in name, name))
    return next((name for name in (*preferred, *others) if ord(character) in _characters(name)), None)


@functools.cache
def _upright_fonts() -> dict[str, tuple[str, int]]:
    """File, and font in the file, of each family."""
    regular = (font for font in fontManager.ttflist if font.style == "normal" and font.weight in (400, "normal"))
    return {font.name: (font.fname, font.index) for font in regular if not font.name.startswith(_NO_LETTERS)}


@functools.cache
def _characters(family: str) -> frozenset[int]:
    """None of a font that cannot be read: matplotlib remembers from one run to the next which ones it has found."""
    path, index = _upright_fonts()[family]
    try:
        return frozenset(FT2Font(path, face_index=index).get_charmap())
    except (OSError, RuntimeError):
        return frozenset()
