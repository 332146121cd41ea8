"""Write the generated parts of docs/: help texts, files, layers, pictures of the sample.

And ``pixcal/__init__.pyi``, from the options of the commands.

A page marks the generated parts: ``<!-- commands: run fit -->`` the help of commands, to its end;
``<!-- file: examples/glow.py -->`` a fenced block; ``<!-- keys: SimulatedOptics -->`` a table, of
the parameters of an effect as well; ``<!-- effects -->`` that of all effects, in the order in which
they act.
"""

import contextlib
import dataclasses
import json
import re
import subprocess
import sys
import tempfile
import typing
from collections.abc import Sequence
from pathlib import Path

import click
from click.testing import CliRunner

import pixcal
from documentation import readme_picture
from documentation.layers import picture
from documentation.stub import STUB, stub
from pixcal.effects import effects
from pixcal.model import acquisition, bench
from pixcal.model.config import meanings
from pixcal.report.detector_figures import nonuniformity, photon_transfer
from pixcal.report.drawing import png
from pixcal.simulation.forward import Stage
from pixcal_cli.main import cli

DOCS = Path(__file__).parents[1] / "docs"
LAYERS = DOCS / "pictures" / "layers.svg"
COMMANDS = re.compile(r"(<!-- commands: ([\w ]+) -->\n).*\Z", re.DOTALL)
FILES = re.compile(r"(<!-- file: (.+?) -->\n\n```[^\n]*\n).*?(```\n)", re.DOTALL)
TABLES = re.compile(r"(<!-- keys: (\w+) -->\n\n)(?:\|.*\n)*")
EFFECTS = re.compile(r"(<!-- effects -->\n\n)(?:\|.*\n)*")
SEE = {
    "pixcal run": "Tutorial: [From FITS to maps](../tutorials/first-maps.md).",
    "pixcal ingest": "How to: [Your own camera](../how-to/own-camera.md). Keys of "
    "`acquisition.yaml`: [Input files](files.md).",
    "pixcal electrons": "How to: [A detector without fringes](../how-to/detector.md).",
    "pixcal fit": "What it computes: [Mathematics](../explanation/mathematics.md).",
    "pixcal diagnose": "How to: [Diagnose a bench](../how-to/diagnose.md).",
    "pixcal astrometry": "How to: [Star centroids](../how-to/astrometry.md).",
    "pixcal compare": "How to: [Repeatability](../how-to/compare.md).",
    "pixcal simulate": "Keys of the bench file: [Bench files](bench-files.md). How to: [Add your "
    "own effect](../how-to/own-effect.md).",
    "pixcal budget": "How to: [Plan an exposure](../how-to/budget.md).",
    "pixcal blind": "Rules: [Blind examination](../explanation/blind-examination.md).",
}
"""Pages that say more."""


def help_text(words: str) -> str:
    """What ``--help`` of a command prints, such as ``pixcal fit``, in a terminal of 80 columns."""
    arguments = [*words.split()[1:], "--help"]
    found = CliRunner().invoke(cli, arguments, prog_name="pixcal", env={"COLUMNS": "80"})
    assert found.exit_code == 0, found.output
    return found.output


def commands_of(group: click.Group = cli, words: str = "pixcal") -> list[str]:
    """All commands as they are typed, those of a group after it."""
    found = []
    for name, command in group.commands.items():
        found.append(f"{words} {name}")
        if isinstance(command, click.Group):
            found += commands_of(command, found[-1])
    return found


def help_of(names: Sequence[str]) -> str:
    """A section for each command and those below it."""
    sections = []
    for words in commands_of():
        if words.split()[1] not in names:
            continue
        more = f"{SEE[words]}\n\n" if words in SEE else ""
        sections.append(f"\n## {words}\n\n{more}```text\n{help_text(words).rstrip()}\n```\n")
    return "".join(sections)


def key_table(name: str) -> str:
    """The keys of a section of a file, from the dataclass that reads it."""
    kind = effects().get(name) or vars(bench).get(name) or vars(acquisition)[name]
    what = "parameter" if name in effects() else "key"
    lines = [f"| {what} | unit | default | meaning |", "|---|---|---|---|"]
    words = meanings(kind)
    for key in dataclasses.fields(kind):
        # Sections have tables of their own.
        if doc := words[key.name]:
            unit = key.metadata.get("unit") or "–"
            if name in effects():
                doc += _parts(typing.get_type_hints(kind)[key.name])
            lines.append(f"| `{key.name}` | {unit} | {_default(key)} | {doc} |")
    return "\n".join(lines) + "\n"


def _parts(kind: object) -> str:
    """Keys of the entries of a list."""
    inside = [part for part in typing.get_args(kind) if dataclasses.is_dataclass(part)]
    names = [f"`{key.name}`" for part in inside for key in dataclasses.fields(part)]
    return f": {', '.join(names)}" if names else ""


def effect_table() -> str:
    """All effects with a page, by stage and in the order in which they act."""
    lines = ["| where | effects, in the order in which they act |", "|---|---|"]
    told = [e for e in effects().values() if (DOCS / f"reference/effects/{e.name}.md").is_file()]
    for stage in Stage:
        own = sorted((e for e in told if e.acts_at == stage), key=lambda e: e.order)
        links = ", ".join(f"[{e.name}](effects/{e.name}.md)" for e in own)
        lines.append(f"| {stage.name.lower()} | {links} |")
    return "\n".join(lines) + "\n"


def _default(field: dataclasses.Field[typing.Any]) -> str:
    value = field.default
    if value is dataclasses.MISSING:
        return "needed" if field.default_factory is dataclasses.MISSING else "–"
    if value in (None, (), ""):
        return "–"
    if isinstance(value, tuple) and dataclasses.is_dataclass(value[0]):
        return f"{len(value)} entries"
    return f"`{list(value) if isinstance(value, tuple) else value}`"


def filled(text: str) -> str:
    """A page with its marked blocks and tables up to date."""
    text = COMMANDS.sub(lambda found: found[1] + help_of(found[2].split()), text)
    text = FILES.sub(lambda found: found[1] + _content(found[2]) + found[3], text)
    text = EFFECTS.sub(lambda found: found[1] + effect_table(), text)
    return TABLES.sub(lambda found: found[1] + key_table(found[2]), text)


def _content(name: str) -> str:
    return (DOCS / name).read_text(encoding="utf-8").rstrip() + "\n"


def draw_sample(folder: Path) -> None:
    """Pictures of the sample acquisition: of the README, and two of the report."""
    with tempfile.TemporaryDirectory() as scratch:
        run = pixcal.run(pixcal.sample_acquisition(), Path(scratch) / "demo")
        readme_picture.draw(run, folder / "readme.png")
        run.delta_x.picture().save(folder / "demo-delta_x.png")
        run.sets["vertical"].allan_picture().save(folder / "demo-allan.png")


def draw_ccd(folder: Path) -> None:
    """Pictures of the real camera, by the first blocks of its page."""
    page = (DOCS / "tutorials" / "real-ccd.md").read_text(encoding="utf-8")
    copy, described = (
        re.search(rf"```{kind}\n(.*?)```", page, re.DOTALL) for kind in ("python", "yaml.*?")
    )
    assert copy
    assert described
    with tempfile.TemporaryDirectory() as scratch, contextlib.chdir(scratch):
        subprocess.run([sys.executable, "-c", copy[1]], check=True)
        Path("ccd/acquisition.yaml").write_text(described[1], encoding="utf-8")
        pixcal.ingest("ccd", "ccd-run")
        pixcal.reduce("ccd-run")
        curves = json.loads(Path("ccd-run/reduce/figures_of_merit.json").read_text())
    for name, figure in (
        ("ccd-photon-transfer", photon_transfer(curves["photon_transfer"], None)),
        ("ccd-dsnu", nonuniformity({"DSNU": curves["dsnu"]})),
    ):
        (folder / f"{name}.png").write_bytes(png(figure))


def main() -> None:
    """Write everything."""
    LAYERS.parent.mkdir(exist_ok=True)
    LAYERS.write_text(picture(), encoding="utf-8")
    STUB.write_text(stub(), encoding="utf-8")
    for page in sorted(DOCS.rglob("*.md")):
        before = page.read_text(encoding="utf-8")
        if (after := filled(before)) != before:
            page.write_text(after, encoding="utf-8")
            print(page)
    draw_sample(LAYERS.parent)
    draw_ccd(LAYERS.parent)


if __name__ == "__main__":
    main()
