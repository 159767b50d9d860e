"""XML files of a bundle as trees: UTF-8, without document types and entities, of bounded size."""

import re
import xml.etree.ElementTree as ET

from service.bundle_rules import BundleFiles
from service.errors import BundleError, HostileBundleError

MAX_XML_NBYTES = 32 << 20
MAX_ELEMENTS = 500_000
MAX_NESTING = 64
_DECLARATION = re.compile(rb"\s*<\?xml[^>]*?encoding\s*=\s*[\"']([^\"']*)[\"']")


def parse_xml(files: BundleFiles, name: str) -> ET.Element:
    """The root of an XML file of the bundle.

    Raises:
        HostileBundleError: a document type or entity, or more elements than any scene needs.
        BundleError: it is too large, no UTF-8 or not well-formed.
    """
    from defusedxml import ElementTree
    from defusedxml.common import DefusedXmlException

    path = files.root / name
    where, nbytes = f"file {name}", path.stat().st_size
    if nbytes > MAX_XML_NBYTES:
        raise BundleError(where, f"must have at most {MAX_XML_NBYTES} bytes", f"{nbytes}")
    content = path.read_bytes()
    _check_encoding(content, where)
    depth = count = 0
    root: ET.Element | None = None
    try:
        with path.open("rb") as file:
            for event, element in ElementTree.iterparse(file, events=("start", "end"), forbid_dtd=True):
                root = element if root is None else root
                depth += 1 if event == "start" else -1
                count += event == "start"
                if depth > MAX_NESTING or count > MAX_ELEMENTS:
                    raise HostileBundleError(
                        where, f"must nest at most {MAX_NESTING} and hold {MAX_ELEMENTS} elements", "more"
                    )
    except DefusedXmlException:
        raise HostileBundleError(where, "must be XML without document type and entities", "one") from None
    except (ET.ParseError, ValueError, LookupError) as error:
        if isinstance(error, BundleError):
            raise
        raise BundleError(where, "must be well-formed XML", " ".join(str(error).split())) from None
    assert root is not None  # otherwise it is not well-formed
    return root


def _check_encoding(content: bytes, where: str) -> None:
    """Two parsers read the file; only in UTF-8 do they surely read the same."""
    declared = _DECLARATION.match(content.removeprefix(b"\xef\xbb\xbf"))
    encoding = declared[1].decode("ascii", "replace").lower() if declared else "utf-8"
    try:
        content.decode("utf-8")
    except UnicodeDecodeError as error:
        raise BundleError(where, "must be UTF-8 text", f"{error.reason} at byte {error.start}") from None
    if encoding not in ("utf-8", "utf8", "us-ascii", "ascii") or b"\x00" in content:
        raise BundleError(where, "must be UTF-8 text", f"{encoding!a} or zero bytes; save it as UTF-8")
