"""Text in any encoding, and numbers as any program writes them."""

import codecs
import re
from pathlib import Path

_MARKS = (
    (codecs.BOM_UTF8, "utf-8"),
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
_END_OF_FILE = "\x1a"
"""What DOS writes behind the last line."""
_CONTROL = re.compile("[\0-\x08\x0e-\x19\x1b-\x1f]")
_WORD = re.compile(r"[0-9A-Za-z#]")
_PLAIN = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eEdD][+-]?\d+)?")
_ENDLESS = re.compile(r"([+-]?)inf(inity)?", re.IGNORECASE)
_MISSING = re.compile(
    r"[+-]?(nan|1[.,]?#\w+)(\(\w*\))?|-nan\(ind\)|null|none|n/?a|no_?data|[-*?]+|", re.IGNORECASE
)
"""What stands for no number: "nan(ind)" and "1.#QNAN" of Windows, "NULL", a dash, nothing."""
_ODD = re.compile(rb"[+-]?\bnan\s*\(\w*\)|[+-]?1[.,]#\w+", re.IGNORECASE)
_DECIMAL = re.compile(rb"(?<=\d),(?=\d)")


def decoded(path: Path, content: bytes) -> str:
    """The text of a file, its lines ended by line feeds, without byte-order marks.

    UTF-8, UTF-16 and UTF-32, told by their marks or by the zeros between letters; else Windows-1252.

    Raises:
      ValueError: it holds control characters, as binary files do, or no letter or digit at all.
    """
    text = content.decode(_encoding(content), errors="replace").replace("\ufeff", "")
    text = text.removesuffix(_END_OF_FILE)
    if _CONTROL.search(text) or (text.strip() and not _WORD.search(text)):
        raise ValueError(
            f"{path} is not a text file: give it the suffix of its format, or export it as text."
        )
    return text.replace("\r\n", "\n").replace("\r", "\n") if "\r" in text else text


def as_utf8(content: bytes) -> bytes:
    """Text of any encoding in UTF-8, without byte-order marks; UTF-8 without one as it is."""
    encoding = _encoding(content)
    if encoding == "utf-8" and codecs.BOM_UTF8 not in content:
        return content
    return content.decode(encoding, errors="replace").replace("\ufeff", "").encode("utf-8")


def with_points(content: bytes) -> bytes:
    """The body of an ascii file with "1,5" as 1.5 and "-nan(ind)" as nan."""
    if any(mark in content for mark in (b".#", b",#", b"(")):
        content = _ODD.sub(b"nan", content)
    return _DECIMAL.sub(b".", content) if b"," in content else content


def number(field: str, *, comma: bool = False) -> float | None:
    """The number in a field, NaN for what stands for none; None where it is something else.

    `comma` says that the decimal mark is a comma.
    """
    if comma:
        field = field.replace(",", ".")
    if _PLAIN.fullmatch(field):
        return float(field.replace("d", "e").replace("D", "e"))
    if found := _ENDLESS.fullmatch(field):
        return float(f"{found[1]}inf")
    return float("nan") if _MISSING.fullmatch(field) else None


def _encoding(content: bytes) -> str:
    for mark, name in _MARKS:
        if content.startswith(mark):
            return name
    head = content[:400]
    if head.count(0) > len(head) // 4:
        return "utf-16-le" if head[1::2].count(0) > head[::2].count(0) else "utf-16-be"
    try:
        content.decode("utf-8")
    except UnicodeDecodeError as error:
        # A letter cut in two by the end of the file is no other encoding.
        return "utf-8" if error.start >= len(content) - 3 else "cp1252"
    return "utf-8"
