"""The truth of a simulation: maps as FITS, geometry and frames of each set as JSON.

It is a separate directory: ``delta_x``, ``delta_y`` (px), ``response``, ``bias`` (ADU),
``dark_rate`` (e-/s) and ``mask`` (`PixelFlag`) as FITS images; ``truth.json`` with the geometry of
each set (``centre_px`` from the window's first pixel, ``kx`` and ``ky`` at its centre in rad/px)
and its frames (``B``, ``A``, ``phi``, ``dkx``, ``dky``); and the bench file.
"""

from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any

from pixcal.engine.run import Runtime, run_tasks
from pixcal.kernels import optics, synthesis
from pixcal.kernels.scene import DetectorMaps, Rows, geometry
from pixcal.model.bench import Bench
from pixcal.simulation.effect import Effect
from pixcal.simulation.exposure import Camera, states_of
from pixcal.simulation.recording import Recording
from pixcal.stages.tiles import spans
from pixcal.storage.manifest import write_json
from pixcal.storage.products import FrameWriter

# maps in the truth; read noise and gain of a simulated detector are equal in all pixels
TRUTH_MAPS = tuple(f for f in fields(DetectorMaps) if f.name not in ("read_noise", "adu_per_e"))


def row_blocks(bench: Bench) -> list[Rows]:
    """The window's rows, in blocks that are simulated separately."""
    return list(spans(bench.detector.shape[0], synthesis.BLOCK_ROWS))


def write_truth(
    bench: Bench,
    effects: tuple[Effect, ...],
    recorded: list[Recording],
    folder: Path,
    runtime: Runtime,
) -> None:
    """Maps as FITS; geometry and frames as JSON."""
    units = {"delta_x": "pix", "delta_y": "pix", "bias": "adu", "dark_rate": "electron/s"}
    maps = [
        FrameWriter.create(
            folder / f"{field.name}.fits",
            bench.detector.shape,
            "uint8" if field.name == "mask" else "float32",
            {"BUNIT": units[field.name]} if field.name in units else None,
        )
        for field in TRUTH_MAPS
    ]
    run_tasks(partial(_write_maps, bench, effects, maps), row_blocks(bench), runtime, label="truth")
    for writer in maps:
        writer.finish()
    sets = {s.folder: _set_truth(bench, effects, s) for s in recorded if s.kind == "fringes"}
    write_json(folder / "truth.json", {"schema": "pixcal/truth/1", "sets": sets})


def _write_maps(
    bench: Bench, effects: tuple[Effect, ...], writers: list[FrameWriter], rows: Rows
) -> None:
    camera = Camera(bench, rows, effects)
    skip = rows[0] - camera.rows[0]
    keep = slice(skip, skip + rows[1] - rows[0])
    for field, writer in zip(TRUTH_MAPS, writers, strict=True):
        writer.write_rows(rows[0], getattr(camera.maps, field.name)[keep])


def _set_truth(bench: Bench, effects: tuple[Effect, ...], recording: Recording) -> dict[str, Any]:
    g, states = geometry(bench, recording.number), states_of(recording, effects)
    ny, nx = bench.detector.shape
    kx, ky = optics.fringe_vector((nx - 1) / 2, (ny - 1) / 2, g)
    return {
        "centre_px": [g.centre_x / g.pitch, g.centre_y / g.pitch],
        "baseline_mm": [g.baseline_x, g.baseline_y, g.baseline_z],
        "distance_mm": g.distance,
        "wavelength_nm": bench.optics.wavelength_nm,
        "interfringe_px": optics.interfringe((float(kx), float(ky))),
        "kx": float(kx),
        "ky": float(ky),
        "electrons": recording.electrons,
        **{"B": states.level.tolist(), "A": states.amplitude.tolist()},
        **{name: getattr(states, name).tolist() for name in ("phi", "dkx", "dky")},
    }
