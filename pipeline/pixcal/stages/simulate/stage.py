"""``pixcal simulate``: an acquisition as a bench would write it, and its truth separately.

The work is divided into tasks of a range of frames and rows, which `pixcal.simulation.exposure`
computes from the bench and its effects only.
"""

import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields
from datetime import datetime, timedelta
from functools import partial
from itertools import product
from operator import call
from pathlib import Path
from typing import Any

from pixcal.effects import known_effects, parse_effects
from pixcal.engine.plan import within_memory
from pixcal.engine.run import Runtime, run_tasks
from pixcal.kernels import synthesis
from pixcal.kernels.scene import Rows
from pixcal.model import acquisition as described
from pixcal.model.bench import Bench, load_bench
from pixcal.model.config import to_plain
from pixcal.model.errors import InputError, naming
from pixcal.model.options import Simulate as Config
from pixcal.model.yaml_file import to_yaml
from pixcal.simulation.effect import Effect
from pixcal.simulation.exposure import Camera
from pixcal.simulation.recording import Recording, recordings
from pixcal.stages.simulate.truth import row_blocks, write_truth
from pixcal.storage.artefact import artefact_key
from pixcal.storage.formats import STAGES, ArtefactKind
from pixcal.storage.lock import lock
from pixcal.storage.manifest import MANIFEST, Manifest, file_digest, read_manifest, write_manifest
from pixcal.storage.products import COMPRESSED, FrameWriter, ascii_text

STAGE, TRUTH = STAGES["simulate"], STAGES["simulate-truth"]
FRAMES_PER_TASK = 128  # frames for which the maps of a block of rows are computed once

# peak memory of a task per pixel of its rows: maps, phases in float64, one frame (measured)
_BYTES_PER_PIXEL = 160

# per pixel and earlier frame that an effect needs: charge before and after, and its noise
_BYTES_PER_FRAME_BACK = 12

# peak memory of a task per sample of a compressed file (measured)
_BYTES_PER_COMPRESSED_SAMPLE = 10

_MJD_EPOCH = datetime(1858, 11, 17)
Effects = tuple[Effect, ...]
# a range of frames of a recording, and their files by number
Span = tuple[Recording, range, dict[int, FrameWriter]]


def run(bench: Path, out: Path, config: Config, runtime: Runtime) -> Manifest:
    """Simulate a bench (schema ``pixcal/bench/1``).

    The directory appears when it is complete. The key of its manifest is a digest, so that it does
    not reveal the truth.
    """
    plan = load_bench(bench)
    there = Target.of(out, "--out", STAGE)
    truth = there.final.with_name(f"{there.final.name}-truth")
    apart = Target.of(config.truth or truth, "--truth", TRUTH)
    if apart.final.is_relative_to(there.final) or there.final.is_relative_to(apart.final):
        raise InputError(
            f"--truth {apart.final}: one directory contains the other ({there.final}); choose "
            "another"
        )
    effects = parse_effects(plan.effects, str(bench), known_effects(config.own))
    for effect in effects:
        with naming(f"{bench}: effects.{effect.name}"):
            effect.check(plan)
    files = {f"effect {file.name}": file_digest(file) for file in config.own}
    key = artefact_key(STAGE.name, STAGE.format, to_plain(plan), files)
    before = there.up_to_date(key)
    # Check both, so that other files at either place are refused.
    if apart.up_to_date(key) and before:
        return before
    with lock(there.aside), there.building() as made, apart.building() as truth_made:
        recorded = recordings(plan)
        runtime = _fitting(plan, recorded, effects, runtime)
        write_truth(plan, effects, recorded, truth_made, runtime)
        shutil.copyfile(bench, truth_made / "bench.yaml")
        for file in config.own:
            shutil.copyfile(file, truth_made / file.name)
        _write_frames(plan, effects, recorded, made, runtime)
        _write_description(plan, made)
        apart.put_in_place(key, to_plain(plan))
        return there.put_in_place(key, {})


def acquire(bench: Bench, effects: Effects, folder: Path, runtime: Runtime) -> None:
    """Write an acquisition into an empty folder, without manifest or truth.

    ``effects`` replace those that the bench names.
    """
    recorded = recordings(bench)
    runtime = _fitting(bench, recorded, effects, runtime)
    _write_frames(bench, effects, recorded, folder, runtime)
    _write_description(bench, folder)


def _fitting(
    bench: Bench, recorded: list[Recording], effects: Effects, runtime: Runtime
) -> Runtime:
    """The runtime with as many workers as fit the memory."""
    ny, nx = bench.detector.shape
    back = sum(e.frames_kept for e in effects)
    need = min(ny, synthesis.BLOCK_ROWS) * nx * (_BYTES_PER_PIXEL + _BYTES_PER_FRAME_BACK * back)
    for recording in recorded:
        if recording.folder in bench.frames.compress:
            planes = min(bench.frames.per_file, recording.count)
            need = max(need, planes * ny * nx * _BYTES_PER_COMPRESSED_SAMPLE)
    return within_memory("simulate", need, 0, runtime)


def _write_frames(
    bench: Bench, effects: Effects, recorded: list[Recording], folder: Path, runtime: Runtime
) -> None:
    batches: list[list[Span]] = [[]]
    ready: list[Callable[[], Path]] = []
    # A task recomputes the memory of its first frame.
    most = max([FRAMES_PER_TASK, *(e.memory.block for e in effects if e.memory)])
    for recording in recorded:
        files = _create_files(bench, recording, folder)
        packed = recording.folder in bench.frames.compress
        ready += [file.finish_compressed if packed else file.finish for file in files]
        for first in range(0, recording.count, most):
            frames = range(first, min(first + most, recording.count))
            used = {n // bench.frames.per_file for n in frames}
            # Short spans together, so that a task has about as many frames.
            if sum(len(s[1]) for s in batches[-1]) + len(frames) > most:
                batches.append([])
            batches[-1].append((recording, frames, {n: files[n] for n in used}))
    pieces = list(product(row_blocks(bench), filter(None, batches)))
    run_tasks(partial(_write_piece, bench, effects), pieces, runtime, label="frames")
    run_tasks(call, ready, runtime, label="files")


def _create_files(bench: Bench, recording: Recording, folder: Path) -> list[FrameWriter]:
    per_file = bench.frames.per_file
    (folder / recording.folder).mkdir(exist_ok=True)
    made = []
    for number, first in enumerate(range(0, recording.count, per_file)):
        planes = min(per_file, recording.count - first)
        shape = bench.detector.shape if per_file == 1 else (planes, *bench.detector.shape)
        path = folder / recording.folder / f"{recording.stem}-{number:05d}.fits"
        made.append(FrameWriter.create(path, shape, "uint16", _cards(bench, recording, first)))
    return made


def _cards(bench: Bench, recording: Recording, frame: int) -> dict[str, Any]:
    """Header of a file whose first frame has this number."""
    seconds = recording.start_s + frame * recording.period_s
    start = datetime.fromisoformat(bench.frames.start).replace(tzinfo=None)
    mjd = (start - _MJD_EPOCH) / timedelta(days=1) + seconds / 86400
    moment = start + timedelta(seconds=seconds)
    return {
        "DATE-OBS": (moment.isoformat(timespec="microseconds"), "start of the first frame"),
        "MJD-OBS": (mjd, "[d] start of the first frame"),
        "TIMESYS": "UTC",
        "EXPTIME": (recording.exptime_s, "[s] exposure time"),
        "CADENCE": (recording.period_s, "[s] frame to frame"),
        "CCD-TEMP": (bench.detector.temperature_c, "[C] detector temperature"),
        "IMAGETYP": recording.kind,
        "OBJECT": recording.folder,
        "INSTRUME": ascii_text(bench.detector.name),
        "ORIGIN": "pixcal simulate",
    }


def _write_piece(bench: Bench, effects: Effects, piece: tuple[Rows, list[Span]]) -> None:
    rows, spans = piece
    camera = Camera(bench, rows, effects)
    for recording, frames, files in spans:
        for frame, samples in camera.expose(recording, frames):
            number, plane = divmod(frame, bench.frames.per_file)
            files[number].write_rows(rows[0], samples, plane)


def _write_description(bench: Bench, folder: Path) -> None:
    """``acquisition.yaml``: what the owner of such a bench would declare."""
    d, o, f = bench.detector, bench.optics, bench.frames

    def globs(name: str) -> tuple[str, ...]:
        return (f"{name}/*{COMPRESSED if name in f.compress else '.fits'}",)

    known = {field.name: getattr(d, field.name) for field in fields(described.Detector)}
    sets = (described.FringeScan(s.name, globs(s.name), s.baseline_mm) for s in f.fringes)
    contents = described.Acquisition(
        schema=described.SCHEMA,
        detector=described.Detector(**known | {"saturation_adu": float(d.top_adu)}),
        optics=described.Optics(
            wavelength_nm=o.wavelength_nm,
            distance_mm=o.nominal_distance_mm or o.distance_mm,
            frame_period_s=f.period_s,
        ),
        frames=described.Frames(
            bias=globs("bias") if f.bias else (),
            dark=globs("dark") if f.darks else (),
            flat=globs("flat") if f.flats else (),
            fringes=tuple(sets),
        ),
    )
    (folder / "acquisition.yaml").write_text(to_yaml(contents), encoding="utf-8")


# Output directories, built at a temporary place and then moved


@dataclass(frozen=True)
class Target:
    """A directory to write, the option that names it, and the kind of its contents."""

    final: Path
    option: str
    stage: ArtefactKind

    @classmethod
    def of(cls, folder: Path, option: str, stage: ArtefactKind) -> "Target":
        """Target at a given directory, which may not exist yet."""
        try:
            folder = folder.resolve()
            folder.parent.mkdir(parents=True, exist_ok=True)
        except (OSError, RuntimeError) as error:  # the latter for circular links
            raise InputError(
                f"{option} {folder}: cannot be created ({error}); choose another"
            ) from error
        return cls(folder, option, stage)

    @property
    def aside(self) -> Path:
        """Temporary place where the directory is built."""
        return self.final.with_name(f".{self.final.name}.partial")

    def up_to_date(self, key: str) -> Manifest | None:
        """Manifest of the present directory, if it has this key and is complete."""
        folder, place = self.final, f"{self.option} {self.final}"
        if not folder.exists():
            return None
        if not folder.is_dir():
            raise InputError(f"{place}: is a file; choose another directory")
        there = {p.relative_to(folder).as_posix() for p in folder.rglob("*") if not p.is_dir()}
        if not there:
            return None
        manifest = read_manifest(folder)
        if manifest is None or manifest.stage != self.stage.name:
            raise InputError(
                f"{place}: not empty, and not made by 'pixcal simulate'; choose another"
            )
        foreign = sorted(there - set(manifest.summary.get("files", {})) - {MANIFEST})
        if foreign:
            raise InputError(f"{folder / foreign[0]}: not made by 'pixcal simulate'; move it away")
        whole = manifest.key == key and _sizes(folder) == manifest.summary.get("files")
        return manifest if whole else None

    @contextmanager
    def building(self) -> Iterator[Path]:
        """An empty temporary directory for the contents, removed at the end."""
        made = self.aside / "made"
        try:
            shutil.rmtree(made, ignore_errors=True)
            made.mkdir(parents=True)
            yield made
        finally:
            shutil.rmtree(self.aside, ignore_errors=True)

    def put_in_place(self, key: str, config: dict[str, Any]) -> Manifest:
        """Write the manifest and replace the present directory by the new one."""
        made, stage = self.aside / "made", self.stage
        summary = {"files": _sizes(made)}
        manifest = Manifest(stage.name, stage.format, key, config, {}, summary=summary)
        write_manifest(made, manifest)
        if self.final.exists():
            old = self.aside / "replaced"
            shutil.rmtree(old, ignore_errors=True)
            self.final.rename(old)
        made.rename(self.final)
        return manifest


def _sizes(folder: Path) -> dict[str, int]:
    files = (p for p in sorted(folder.rglob("*")) if p.is_file() and p != folder / MANIFEST)
    return {p.relative_to(folder).as_posix(): p.stat().st_size for p in files}
