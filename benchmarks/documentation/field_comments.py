"""Extension of griffe: comments beside or above the fields of a class are shown on the site."""

import re
from typing import Any

import griffe

OF_SEVERAL = re.compile(r"(\w+(?:, \w+)*): (.+)")


class FieldComments(griffe.Extension):
    """Comments of fields as their docstrings, unless that of the class describes them."""

    def on_class_members(self, *, cls: griffe.Class, **_: Any) -> None:
        """Called by griffe with each class that it has read."""
        if cls.docstring and "Attributes\n" in cls.docstring.value:
            return
        fields = {name: one for name, one in cls.attributes.items() if "property" not in one.labels}
        for name, field in fields.items():
            text = comment(cls.lines_collection[cls.filepath], field.lineno, field.endlineno)
            shared = OF_SEVERAL.fullmatch(text)
            several = shared[1].split(", ") if shared else []
            described = dict.fromkeys(several, shared[2]) if {*several} & {*fields} else {}
            for one, meaning in (described or {name: text}).items():
                if meaning and one in fields and not fields[one].docstring:
                    fields[one].docstring = griffe.Docstring(meaning, parent=fields[one])


def comment(lines: list[str], first: int, last: int) -> str:
    """Comment at the end of a statement (lines ``first`` to ``last``), or else above it."""
    if beside := re.search(r"  # (.*)$", lines[last - 1]):
        return beside[1]
    above = first - 1
    while lines[above - 1].lstrip().startswith("# "):
        above -= 1
    return " ".join(line.strip()[2:] for line in lines[above : first - 1])
