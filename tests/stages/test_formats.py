"""The formats of artefacts are those that the documentation describes."""

import re
from pathlib import Path

from pixcal.storage.formats import STAGES

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "run-directory.md"


def test_the_page_describes_every_format() -> None:
    text = PAGE.read_text(encoding="utf-8")
    told = {
        name: int(n) for name, n in re.findall(r"^\*\*`RUN/(\w+)`\*\* \(format (\d+)", text, re.M)
    }
    (of_compare,) = re.findall(r"`pixcal compare --out DIR`\*\* \(format (\d+)\)", text)
    (of_simulate,) = re.findall(r"`ACQ` of `pixcal simulate` .*\(format (\d+)\)", text)
    told |= {"compare": int(of_compare), "simulate": int(of_simulate)}
    assert told | {"simulate-truth": told["simulate"]} == {
        s.name: s.format for s in STAGES.values()
    }
