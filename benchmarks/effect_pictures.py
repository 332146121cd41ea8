"""Change of the offsets by each effect, for its page: ``make effect-pictures``.

The bench of ``configs/effects.yaml`` is simulated, reduced and fitted without and with each effect,
with the same noise: the difference of the maps is due to the effect. Drawn at the default strength,
except for `STRONGER`; all numbers are measured in this run.
"""

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

import pixcal
from pixcal.effects import effects
from pixcal.model.config import to_plain
from pixcal.report.colours import BLUE, DIVERGING, RED
from pixcal.report.drawing import axes_grid, draw_blocks, finish, png, unit_for
from pixcal.report.text import SYMBOLS, number
from pixcal.storage.products import read_map
from study import reduced

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


def fitted(on: dict[str, Any]) -> Maps:
    """Fitted maps of the bench with given effects."""
    bench = yaml.safe_load((ROOT / "configs" / "effects.yaml").read_text(encoding="utf-8"))
    with reduced(bench | {"effects": on}) as run:
        # Straight fringes are assumed: what a richer shape could absorb is part of the picture.
        pixcal.fit(run, model="paraxial")
        found = [read_map(run / "products" / f"{axis}.fits")[:2] for axis in AXES]
    return Maps(*(np.stack([f[n] for f in found]).astype(float) for n in (0, 1)))


def draw(title: str, change: F64, sigma: F64, file: Path) -> None:
    """Maps of the change and the means of their columns and rows."""
    limit = max(float(np.nanpercentile(np.abs(change), 99)), 1e-6)
    unit = unit_for([limit], "px")
    scale: Any = {"cmap": DIVERGING, "vmin": -unit.factor * limit, "vmax": unit.factor * limit}
    figure, axes = axes_grid(
        (7.6, 6.0),
        2,
        2,
        right=1.0,
        bottom=0.9,
        top=0.9,
        beside=0.65,
        between=0.65,
        height_ratios=(3, 1.3),
    )
    for n, name in enumerate(AXES):
        drawn = draw_blocks(axes[0, n], unit.factor * change[n], aspect="auto", **scale)
        rms = number(float(np.nanstd(change[n])), 2)
        axes[0, n].set_title(f"change of {SYMBOLS[name]}: {rms} px rms", fontsize=10)
        axes[0, n].set_xlabel("x (px)")
        for axis, label, colour in ((0, "columns (along x)", BLUE), (1, "rows (along y)", RED)):
            means = unit.factor * np.nanmean(change[n], axis=axis)
            axes[1, n].plot(means, color=colour, lw=1, label=f"mean of {label}")
        finish(axes[1, n], xlabel="x or y (px)")
    axes[0, 0].set_ylabel("y (px)")
    axes[1, 0].set_ylabel(f"mean ({unit.label})")
    ends = axes[0, 1].get_position()
    bar = figure.add_axes((ends.x1 + 0.02, ends.y0, 0.02, ends.height))
    figure.colorbar(drawn, cax=bar).set_label(f"change ({unit.label})")
    errors = ", ".join(number(float(np.nanmedian(s)), 2) for s in sigma)
    figure.suptitle(title, fontsize=12, y=0.985)
    figure.text(0.5, 0.915, f"errors of the maps: {errors} px", ha="center", fontsize=9.5)
    handles, labels = axes[1, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="lower center", ncols=2, fontsize=9, frameon=False)
    file.write_bytes(png(figure))


def main() -> None:
    """Draw all effects, or the named ones."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help="effects; default: all")
    names = parser.parse_args().names or list(effects())
    plain = fitted({})
    for name in names:
        effect = effects()[name]().scaled(STRONGER.get(name, 1.0))
        change = fitted({name: to_plain(effect)}).delta - plain.delta
        times = f", {number(STRONGER[name])} times the default" if name in STRONGER else ""
        draw(f"{name}: {effect.title}{times}", change, plain.sigma, PAGES / f"{name}.png")
        rms = [float(np.nanstd(c)) for c in change]
        print(f"{name:22} changes delta_x by {rms[0]:.1e}, delta_y by {rms[1]:.1e} px rms")


if __name__ == "__main__":
    main()
