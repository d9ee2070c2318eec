"""Elements of XML files that are not trusted: no document type, no entities, limited depth and number."""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple
from xml.parsers import expat

from neuido.data.files.parsing import one_line, read_text
from neuido.errors import UserError

DEEPEST = 100
"""Deepest nesting of elements; robots have chains of some tens of links."""
MOST = 200_000
"""Largest number of elements."""


class Element(NamedTuple):
    """An element with its attributes and children."""

    tag: str
    attributes: dict[str, str]
    children: "list[Element]"
    place: str
    """File and line, for messages."""

    def get(self, name: str, default: str = "") -> str:
        """Return an attribute."""
        return self.attributes.get(name, default)

    def named(self, *tags: str) -> "list[Element]":
        """Return the children with one of these tags."""
        return [child for child in self.children if child.tag in tags]

    def first(self, tag: str) -> "Element | None":
        """Return the first child with a tag, or None."""
        return next(iter(self.named(tag)), None)

    def numbers(self, name: str, count: int | None = None, default: tuple[float, ...] | None = None) -> tuple[float, ...] | None:
        """Return the numbers of an attribute; `default` where it is absent.

        Args:
            name: The attribute.
            count: How many there must be; None: any number.
            default: What is returned where the attribute is absent.

        Raises:
            UserError: They are not finite numbers, or not so many.
        """
        if name not in self.attributes:
            return default
        try:
            found = tuple(float(word) for word in self.attributes[name].split())
        except ValueError:
            found = (float("nan"),)
        if any(value != value or abs(value) == float("inf") for value in found) or (count is not None and len(found) != count):
            if "$(" in self.attributes[name] or "${" in self.attributes[name]:
                raise UserError(
                    f"{self.place}: {name} of {self.tag} is a macro, {self.attributes[name][:80]!r}: expand it with xacro first"
                )
            many = "finite numbers" if count is None else f"{count} finite number{'s' * (count > 1)}"
            raise UserError(f"{self.place}: {name} of {self.tag} must be {many}, got {self.attributes[name][:80]!r}")
        return found

    def number(self, name: str, default: float) -> float:
        """Return the number of an attribute; `default` where it is absent.

        Raises:
            UserError: It is not a finite number.
        """
        found = self.numbers(name, 1)
        return default if found is None else found[0]


def read_xml(path: Path) -> Element:
    """Read an XML file.

    Raises:
        UserError: The file is missing, too large, not valid XML, declares a document type or an entity, or has too many elements.
    """
    text = read_text(path, "is not valid XML").lstrip()  # robots often have a blank line before the XML declaration
    parser = expat.ParserCreate(encoding="utf-8")
    root: list[Element] = []
    open_elements: list[Element] = []
    count = 0

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal count
        count += 1
        if len(open_elements) >= DEEPEST or count > MOST:
            raise UserError(
                f"{path}:{parser.CurrentLineNumber}: it has more than {MOST} elements, or more than {DEEPEST} inside one another"
            )
        own = Element(tag, attributes, [], f"{path}:{parser.CurrentLineNumber}")
        (open_elements[-1].children if open_elements else root).append(own)
        open_elements.append(own)

    def refuse(*_: object) -> None:
        raise UserError(f"{path}:{parser.CurrentLineNumber}: it declares a document type or an entity, which is not read: remove the line")

    parser.StartElementHandler = start
    parser.EndElementHandler = lambda _: open_elements.pop()
    parser.StartDoctypeDeclHandler = parser.EntityDeclHandler = parser.ExternalEntityRefHandler = refuse
    try:
        parser.Parse(text, True)
    except expat.ExpatError as error:
        raise UserError(f"{path}:{error.lineno}: it is not valid XML: {one_line(error)}") from error
    return root[0]


def walk(element: Element) -> Iterator[Element]:
    """Yield an element and all below it."""
    yield element
    for child in element.children:
        yield from walk(child)
