"""XML of strangers: parsed without entities, within limits, and its attributes as values or as a typed error."""

from __future__ import annotations

import math
import re
from collections.abc import Container
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn
from xml.etree import ElementTree

from ctmhe.errors import FmuArchiveError

MAX_BYTES = 64 << 20  # of one file; 100,000 variables need some 30 MB
MAX_DEPTH = 64  # the schemas need 6, annotations of tools a few more
MAX_ELEMENTS = 2_000_000  # what MAX_BYTES could hold of the shortest ones is ten times as many

Element = ElementTree.Element
NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?", re.ASCII)  # float() also takes 1_0 and ١
LONGEST_NUMBER = 1000  # characters; more are no number but an attack
SPECIAL = {"INF": math.inf, "+INF": math.inf, "-INF": -math.inf, "NAN": math.nan}
TRUTH = {"true": True, "1": True, "false": False, "0": False}
LARGEST_REFERENCE = 2**32 - 1


def parse(path: Path, tag: str) -> Element:
    """Return the root of an XML file; text between the elements is left out.

    Raises
    ------
    FmuArchiveError
        If it cannot be parsed, has a document type or entities, exceeds a limit, or its root is not `tag`.
    """
    where = path.name
    try:
        content = path.read_bytes()
    except OSError as error:
        raise FmuArchiveError(f"{where} cannot be read: {error.strerror}") from error
    if len(content) > MAX_BYTES:
        raise FmuArchiveError(f"{where} has {len(content) >> 20} MiB, more than the {MAX_BYTES >> 20} allowed")
    parser = ElementTree.XMLParser(target=_Builder(where))
    try:
        parser.feed(content)
        root = parser.close()
    except (ElementTree.ParseError, ValueError, LookupError) as error:  # the latter two: encodings
        raise FmuArchiveError(f"{where} cannot be parsed: {error}; export the FMU again") from error
    if root.tag != tag:
        raise FmuArchiveError(f"{where} is a <{root.tag[:60]}>, expected <{tag}>; export the FMU again")
    return root


class _Builder:
    """Builds the tree from what expat finds, and stops where no description of an FMU would go."""

    def __init__(self, where: str):
        self._where, self._tree, self._depth, self._count = where, ElementTree.TreeBuilder(), 0, 0

    def doctype(self, name: str, public: str | None, system: str | None) -> NoReturn:
        raise FmuArchiveError(f"{self._where} has a DOCTYPE, which is refused because it may define entities")

    def start(self, tag: str, attributes: dict[str, str]) -> Element:
        self._depth += 1
        self._count += 1
        if self._depth > MAX_DEPTH or self._count > MAX_ELEMENTS:
            what = f"deeper than {MAX_DEPTH}" if self._depth > MAX_DEPTH else f"more than {MAX_ELEMENTS} elements"
            raise FmuArchiveError(f"{self._where} is {what}, which no FMU needs; export the FMU again")
        return self._tree.start(tag, attributes)

    def end(self, tag: str) -> Element:
        self._depth -= 1
        return self._tree.end(tag)

    def close(self) -> Element:
        return self._tree.close()


@dataclass(frozen=True)
class Reader:
    """The attributes of an element as values; what is wrong is told with the file, the owner and the attribute.

    Attributes
    ----------
    element : Element
    owner : str
        What the element describes, such as `variable 'x'`.
    where : str
        The file.
    """

    element: Element
    owner: str
    where: str = "modelDescription.xml"

    def fail(self, name: str, problem: str) -> FmuArchiveError:
        """Return the error of an attribute."""
        value = self.element.get(name)
        given = "is missing" if value is None else f"is {_short(value)}"
        return FmuArchiveError(
            f"{self.where}: {self.owner}: attribute {name!r} {given}, {problem}; export the FMU again"
        )

    def text(self, name: str, default: str = "") -> str:
        """Return an attribute as it is."""
        return self.element.get(name, default)

    def required(self, name: str) -> str:
        """Return an attribute that must not be missing or empty."""
        value = self.element.get(name)
        if not value:
            raise self.fail(name, "expected a text")
        return value

    def word(self, name: str, allowed: Container[str], default: str) -> str:
        """Return an attribute that is one of some words."""
        value = self.element.get(name, default)
        if value not in allowed:
            raise self.fail(name, "which FMI does not know")
        return value

    def truth(self, name: str, default: bool = False) -> bool:
        """Return an attribute that is true or false."""
        value = self.element.get(name)
        if value is None:
            return default
        if value.strip() not in TRUTH:
            raise self.fail(name, "expected true or false")
        return TRUTH[value.strip()]

    def number(self, name: str, *, finite: bool = False, nan: bool = False) -> float | None:
        """Return an attribute that is a number, or None; `nan` allows NaN, `finite` forbids infinity."""
        value = self.element.get(name)
        if value is None:
            return None
        text = value.strip()
        plain = len(text) <= LONGEST_NUMBER and NUMBER.fullmatch(text)
        number = float(text) if plain else SPECIAL.get(text.upper())
        if number is None:
            raise self.fail(name, "expected a number")
        if (math.isnan(number) and not nan) or (math.isinf(number) and finite):
            raise self.fail(name, "expected a finite number" if finite else "expected a number")
        return number

    def whole(self, name: str, largest: int = LARGEST_REFERENCE) -> int | None:
        """Return an attribute that is a whole number from 0, or None."""
        value = self.element.get(name)
        if value is None:
            return None
        number = _whole(value.strip(), largest)
        if number is None:
            raise self.fail(name, f"expected a whole number from 0 to {largest}")
        return number

    def reference(self, name: str) -> int:
        """Return an attribute that is a whole number and must not be missing."""
        number = self.whole(name)
        if number is None:
            raise self.fail(name, "expected a whole number")
        return number

    def references(self, name: str) -> list[int] | None:
        """Return an attribute that is a list of whole numbers, or None."""
        value = self.element.get(name)
        if value is None:
            return None
        numbers = [_whole(text, LARGEST_REFERENCE) for text in value.split()]
        if None in numbers:
            raise self.fail(name, "expected whole numbers")
        return [number for number in numbers if number is not None]


def _whole(text: str, largest: int) -> int | None:
    if not re.fullmatch(r"\+?\d{1,20}", text, re.ASCII):
        return None
    number = int(text)
    return number if number <= largest else None


def _short(text: str) -> str:
    return repr(text if len(text) <= 60 else text[:57] + "...")
