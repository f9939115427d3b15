"""XML trees as text."""

from __future__ import annotations

from xml.etree import ElementTree as ET


def xml_text(root: ET.Element) -> str:
    """Return a document of one element, indented, with a declaration and a line end."""
    ET.indent(root, "  ")
    body = ET.tostring(root, encoding="unicode")
    return f'<?xml version="1.0" encoding="UTF-8" standalone="yes" ?>\n{body}\n'


def add_text(parent: ET.Element, tag: str, text: str) -> None:
    """Append an element that holds text."""
    ET.SubElement(parent, tag).text = text
