"""Common steps of every stage: check requirements, lock, key, build and products."""

import gc
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pixcal.model.acquisition import Acquisition
from pixcal.model.config import parse
from pixcal.model.errors import DamagedError, InputError
from pixcal.storage.artefact import Build, artefact_key, build, up_to_date
from pixcal.storage.folder import written_aside
from pixcal.storage.formats import STAGES, ArtefactKind
from pixcal.storage.lock import lock
from pixcal.storage.manifest import Manifest, check_intact, read_json, read_manifest
from pixcal.storage.place import Local, Place


def require(run: Path, name: str) -> Manifest:
    """Manifest of a required stage; InputError if it was not run, or has another format."""
    if not run.is_dir():
        raise InputError(f"{run}: no such run directory; make one with 'pixcal ingest'")
    stage, folder = STAGES[name], run / name
    command = stage.typed(run)
    try:
        manifest = read_manifest(folder)
        if manifest is not None:
            check_intact(folder, manifest)
    except DamagedError as error:
        error.advice = f"make it again with '{command}'"
        raise
    if manifest is None:
        if stage.of_fringes and without_fringes(run):
            raise InputError(f"{run}: no {name}: its acquisition.yaml lists no frames.fringes")
        raise InputError(f"{folder}: not there yet; run '{command}' first")
    if manifest.stage != name or manifest.format not in (stage.format, *stage.earlier):
        raise InputError(
            f"{folder}: format {manifest.stage}/{manifest.format}; this version of pixcal reads "
            f"{name}/{stage.format}; run '{command}' again"
        )
    return manifest


def read_acquisition(run: Local) -> Acquisition:
    """The acquisition that was ingested."""
    file = run / "ingest" / "acquisition.json"
    return parse(Acquisition, read_json(file), str(file))


def without_fringes(run: Path) -> bool:
    """Whether the ingested acquisition has only detector frames."""
    try:
        return not read_json(run / "ingest" / "acquisition.json")["frames"]["fringes"]
    except (DamagedError, LookupError):
        return False


@contextmanager
def working(run: Path, *needed: str) -> Iterator[dict[str, str]]:
    """Hold a run with required stages; gives the keys of their artefacts."""
    for name in needed:
        require(run, name)
    with lock(run):
        # Read again, since another process may have replaced them meanwhile.
        yield {name: require(run, name).key for name in needed}


def make(
    run: Path,
    stage: ArtefactKind,
    config: dict[str, Any],
    inputs: Mapping[str, str],
    body: Callable[[Build], object],
    *,
    cubes: Place | None = None,
    keep: Callable[[Manifest], bool] = lambda _ready: True,
    publish: Callable[[], object] = lambda: None,
    published: Callable[[], bool] = lambda: False,
) -> Manifest:
    """Make the artefact of a stage, unless it is up to date, in a run that the caller holds.

    config, inputs : options that affect the result; keys of its inputs
    body : writes it, into the folder of a `Build`
    cubes : as in `pixcal.storage.artefact.build`
    keep : whether an artefact that is up to date can be kept
    publish, published : writes products besides `ArtefactKind.products`; whether they exist
    """
    key = artefact_key(stage.name, stage.format, config, dict(inputs))
    ready = up_to_date(run, stage.name, key)
    stays = ready is not None and keep(ready)
    if ready is None or not stays:
        with build(run, stage.name, stage.format, config, dict(inputs), cubes=cubes) as made:
            # Exclude existing objects, which are permanent, from garbage collection.
            gc.freeze()
            try:
                body(made)
            finally:
                gc.unfreeze()
        ready = require(run, stage.name)
    if not (stays and published()):
        if stage.products:
            _copy_products(run, stage)
        publish()
    return ready


def _copy_products(run: Path, stage: ArtefactKind) -> None:
    """Copy files of an artefact to ``RUN/products``; remove others that match the pattern."""
    pattern = stage.products
    folder, products = run / stage.name, run / "products"
    products.mkdir(exist_ok=True)
    files = [file for file in folder.glob(pattern) if file.is_file()]
    for other in {file.name for file in products.glob(pattern)} - {file.name for file in files}:
        (products / other).unlink()
    for file in files:
        with written_aside(products / file.name, durable=True) as aside:
            shutil.copyfile(file, aside)
