"""Docstrings are plain text: what reStructuredText would read as marks is kept as it is written.

Their sections (`Args:` and the like) become lists, what stands indented by four outside of them
blocks of code.
"""

import re

from sphinx.application import Sphinx

_MARKS = re.compile(r"(`[^`]+`)|([*|\\])|(?<=\w)_(?!\w)")
_HEADINGS = {
    "Args": "Arguments",
    "Attributes": "Attributes",
    "Raises": "Raises",
    "Returns": "Returns",
    "Example": "Example",
}
_SECTION = re.compile(rf"({'|'.join(_HEADINGS)}):")
_ENTRY = re.compile(r"    ([*\w.]+(?:, [*\w.]+)*): (.*)")


def _escaped(line: str) -> str:
    """The line with its asterisks, bars and names that end in `_` as characters, code as it is."""
    return _MARKS.sub(lambda found: found[1] or "\\" + found[0], line)


def _entry(names: str, text: str) -> str:
    marked = ", ".join(f"**{_escaped(name)}**" for name in names.split(", "))
    return f"- {marked}: {_escaped(text)}"


def _in_section(line: str) -> str:
    """A line of a section: the first of an entry begins an item of a list."""
    found = _ENTRY.fullmatch(line)
    if found:
        return _entry(found[1], found[2])
    return "  " + _escaped(line.strip()) if line.startswith("     ") else _escaped(line.strip())


def _section(name: str, lines: list[str]) -> list[str]:
    body = [line[4:] for line in lines] if name == "Example" else list(map(_in_section, lines))
    return ["", f".. rubric:: {_HEADINGS[name]}", "", *body, ""]


def _prose(lines: list[str]) -> list[str]:
    out: list[str] = []
    before, in_code = "", False
    for line in lines:
        in_list = before.startswith(("- ", "  ")) and not in_code
        if line.strip() and not line.startswith(" ") and in_code:
            out.append("")
            in_code = False
        if line.startswith("- ") and before and not in_list:
            out.append("")
        if line.startswith("    ") and not (in_code or in_list):
            out += ["", "::", ""]
            in_code = True
        out.append(line if in_code else _escaped(line))
        before = line
    return out


def as_marked_up(lines: list[str]) -> list[str]:
    """The docstring in reStructuredText."""
    heads = [i for i, line in enumerate(lines) if _SECTION.fullmatch(line)]
    bounds = [*heads, len(lines)]
    out = _prose(lines[: bounds[0]])
    for first, end in zip(bounds[:-1], bounds[1:], strict=True):
        last = first + 1
        while last < end and (not lines[last].strip() or lines[last].startswith(" ")):
            last += 1
        out += _section(lines[first][:-1], lines[first + 1 : last]) + _prose(lines[last:end])
    return out


def _process(app, what, name, obj, options, lines: list[str]) -> None:
    lines[:] = as_marked_up(lines)


def _skip(app, what, name, obj, skip: bool, options) -> bool | None:
    """Fields of named tuples are told in the docstring of the tuple."""
    told = (getattr(obj, "__doc__", None) or "").startswith("Alias for field number")
    return True if told else None


def setup(app: Sphinx) -> dict[str, bool]:
    app.connect("autodoc-process-docstring", _process)
    app.connect("autodoc-skip-member", _skip)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
