"""Arguments and options that several commands share, and the types of their values."""

import functools
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

Command = Callable[..., Any]


def memory_size(text: str) -> int:
    """Bytes of a size written ``512MiB``, ``2GiB``, ``2G`` or plainly; ``GB`` is decimal."""
    found = re.fullmatch(r"(\d{1,15}(?:\.\d{1,9})?) ?([kmgt]?)(i?b)?", text.strip().lower())
    if found is None or (found[3] == "ib" and not found[2]):
        raise click.BadParameter(f"{text!r:.40} is not a size; write for example 512MiB or 2GiB")
    number, prefix, suffix = found.groups()
    base = 1000 if suffix == "b" else 1024
    size = int(float(number) * base ** " kmgt".index(prefix or " "))
    if size < 1 << 20:
        raise click.BadParameter(f"{text!r:.40} is below 1 MiB; write for example 2GiB")
    return size


def region(text: str) -> tuple[int, int, int, int]:
    """Limits (y0, y1, x0, x1) of a rectangle written ``y0:y1,x0:x1``, ends excluded."""
    found = re.fullmatch(r"(\d{1,6}):(\d{1,6}),(\d{1,6}):(\d{1,6})", text.strip())
    if found is None:
        raise click.BadParameter(f"{text!r:.40} is not y0:y1,x0:x1, for example 0:128,0:256")
    y0, y1, x0, x1 = map(int, found.groups())
    if y0 >= y1 or x0 >= x1:
        raise click.BadParameter(f"{text!r:.40} is empty: the ends are excluded")
    return y0, y1, x0, x1


def examples(*lines: str) -> str:
    """Text at the foot of a command's help: shell lines that show its use."""
    title = "Example:" if len(lines) == 1 else "Examples:"
    return "\n".join(["\b", title, *(f"  {line}" for line in lines)])


acquisition_argument = click.argument("acquisition", metavar="ACQ", type=click.Path(path_type=Path))
run_argument = click.argument("run", metavar="RUN", type=click.Path(path_type=Path))
out_run_option = click.option(
    "--out",
    "run",
    metavar="RUN",
    required=True,
    type=click.Path(path_type=Path),
    help="Directory of the results; made if it is not there.",
)
overwrite_option = click.option(
    "--overwrite", is_flag=True, help="Replace what was ingested from another acquisition."
)
copy_option = click.option(
    "--copy",
    is_flag=True,
    help="Copy the samples of all frames: later steps do without the files of ACQ.",
)
cubes_option = click.option(
    "--cubes",
    metavar="PLACE",
    help="Folder or URL (s3://bucket/prefix) for the large cubes; RUN to keep them there. "
    "[default: as before, or as in ingest; else RUN]",
)
gain_option = click.option(
    "--gain",
    type=click.Choice(["declared", "measured"]),
    default="declared",
    show_default=True,
    help="The gain that electrons are counted with: the owner's, or that of the flats.",
)
model_option = click.option(
    "--model",
    type=click.Choice(["paraxial", "hyperbolic", "auto"]),
    default="auto",
    show_default=True,
    help="Shape of the fringes: straight, hyperbolic, or whichever the phases call for.",
)


def runtime_options(command: Command) -> Command:
    """Add the options on how to run; the command receives them as ``runtime``."""

    @click.option("--quiet", is_flag=True, help="No progress on stderr.")
    @click.option(
        "--cluster",
        default="threads",
        show_default=True,
        metavar="threads|processes|sync|tcp://…",
        help="Where tasks run: here, or on a Dask cluster at this address.",
    )
    @click.option(
        "--workers",
        type=click.IntRange(0, 4096),
        default=0,
        show_default="all cores",
        metavar="N",
        help="Tasks at the same time.",
    )
    @click.option(
        "--memory",
        type=memory_size,
        default="2GiB",
        show_default=True,
        metavar="SIZE",
        help="Memory that may be used; work that needs more is refused.",
    )
    @functools.wraps(command)
    def with_runtime(
        *args: Any, quiet: bool, cluster: str, workers: int, memory: int, **options: Any
    ) -> Any:
        # Here, not at the top: Dask takes longer to import than all of `pixcal --help`.
        from pixcal.engine.run import Runtime

        runtime = Runtime(cluster=cluster, workers=workers, memory=memory, quiet=quiet)
        return command(*args, runtime=runtime, **options)

    return with_runtime
