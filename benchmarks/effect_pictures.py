"""What every effect does to the offsets, for its page: ``make effect-pictures``.

The bench of ``configs/effects.yaml`` is simulated, reduced and fitted without and with each effect,
with the same noise: the difference of the maps is the effect's. Drawn at the strength of its
defaults, but for `STRONGER`; all numbers are measured in this run.
"""

import argparse
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("agg")
import matplotlib.pyplot as plt
import numpy as np
import yaml
from numpy.typing import NDArray

from pixcal.effects import effects
from pixcal.engine.run import Runtime
from pixcal.model.config import to_plain
from pixcal.stages import fit, ingest, reduce, simulate
from pixcal.storage.products import read_map

ROOT = Path(__file__).parents[1]
PAGES = ROOT / "docs" / "reference" / "effects"
AXES = ("delta_x", "delta_y")
STRONGER = {"cosmic_hits": 3e4}
"""Times the strength of the defaults at which an effect is drawn, where these show nothing."""
F64 = NDArray[np.float64]


@dataclass(frozen=True)
class Maps:
    """Offsets and errors of both axes, px: (axis, y, x)."""

    delta: F64
    sigma: F64


def fitted(folder: Path, on: dict[str, Any], detector: dict[str, Any] | None = None) -> Maps:
    """Maps of the bench with some effects."""
    bench = yaml.safe_load((ROOT / "configs" / "effects.yaml").read_text(encoding="utf-8"))
    bench["effects"] = on
    bench["detector"] |= detector or {}
    folder.mkdir()
    (folder / "bench.yaml").write_text(yaml.safe_dump(bench), encoding="utf-8")
    runtime = Runtime(cluster="sync")
    run = folder / "run"
    simulate.run(folder / "bench.yaml", folder / "acq", simulate.Config(), runtime)
    ingest.run(folder / "acq", run, ingest.Config(), runtime)
    reduce.run(run, reduce.Config(), runtime)
    # Straight fringes are assumed: what a richer shape could absorb is part of the picture.
    fit.run(run, fit.Config(model="paraxial"), runtime)
    found = [read_map(run / "products" / f"{axis}.fits")[:2] for axis in AXES]
    return Maps(*(np.stack([f[n] for f in found]).astype(float) for n in (0, 1)))


def draw(title: str, change: F64, sigma: F64, file: Path) -> None:
    """Maps of the change and their profiles, in 1e-3 px."""
    milli = 1e3 * change
    limit = max(float(np.nanpercentile(np.abs(milli), 99)), 1e-3)
    figure, axes = plt.subplots(2, 2, figsize=(7.6, 6.4), height_ratios=(3, 1.3), dpi=110)
    for n, name in enumerate(AXES):
        picture = axes[0, n].imshow(
            milli[n], cmap="RdBu_r", vmin=-limit, vmax=limit, origin="lower"
        )
        rms = float(np.nanstd(milli[n]))
        error = 1e3 * float(np.nanmedian(sigma[n]))
        axes[0, n].set_title(f"change of {name}\n{rms:.2g}e-3 px rms", fontsize=10)
        axes[0, n].set_xlabel(f"x, px\nnoise of the map: {error:.2g}e-3 px", fontsize=9)
        # In the unit of the profiles below.
        figure.colorbar(picture, ax=axes[0, n], shrink=0.85)
        for axis, label in ((0, "mean of columns, along x"), (1, "mean of rows, along y")):
            axes[1, n].plot(np.nanmean(milli[n], axis=axis), lw=1, label=label)
        axes[1, n].set_xlabel("px", fontsize=9)
        axes[1, n].grid(alpha=0.3)
    axes[0, 0].set_ylabel("y, px")
    axes[1, 0].set_ylabel("change, 1e-3 px")
    handles, labels = axes[1, 0].get_legend_handles_labels()
    figure.suptitle(title)
    figure.tight_layout(rect=(0.01, 0.03, 1, 1))
    figure.legend(handles, labels, loc="lower center", ncols=2, fontsize=8, frameon=False)
    figure.savefig(file, metadata={"Software": None})
    plt.close(figure)


def main() -> None:
    """Draw all, or those that are named."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help="effects; default: all")
    names = parser.parse_args().names or list(effects())
    with tempfile.TemporaryDirectory() as scratch:
        plain = fitted(Path(scratch) / "plain", {})
        for name in names:
            effect = effects()[name]().scaled(STRONGER.get(name, 1.0))
            maps = fitted(Path(scratch) / name, {name: to_plain(effect)})
            change = maps.delta - plain.delta
            times = f", {STRONGER[name]:.0e} times the default" if name in STRONGER else ""
            draw(f"{name}: {effect.title}{times}", change, plain.sigma, PAGES / f"{name}.png")
            rms = [float(np.nanstd(c)) for c in change]
            print(f"{name:22} changes delta_x by {rms[0]:.1e}, delta_y by {rms[1]:.1e} px rms")


if __name__ == "__main__":
    main()
